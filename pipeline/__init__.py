"""Processing of many tiles: configuration, graph, store, execution, command line."""

import atexit
import os
import sys
import tempfile
from pathlib import Path

from flexroad.catalog.gdal_options import use_own_values

ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMBA_NUM_THREADS",
        "GDAL_NUM_THREADS",
    ),
    "1",
)
"""Environment of every process: on a tile's arrays two BLAS threads are up to 400 times slower than one."""
OF_WORKERS = ONE_THREAD | {"PYTHONSAFEPATH": "1"}
"""Environment of worker processes. They start as ``python -c`` or ``-m``. Without this setting, modules of
the current folder would replace Python's own modules: a folder of downloads could run code."""

# Libraries read these variables once, on import, so they are set before any import. Values set by the user
# are kept. If NumPy is already imported (as in a notebook), nothing is changed: numba raises an error when
# its number of threads changes.
if "numpy" not in sys.modules:
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)

IGNORED = use_own_values()
"""A line on settings of GDAL and PROJ that this process ignores; empty if none is set."""


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _set_numba_cache() -> None:
    """Set a temporary numba cache folder if none of the default folders is writable.

    Numba needs such a folder. A service account without a home folder, with a system-wide installation, does
    not have it. Workers inherit the setting.
    """
    beside = Path(__file__).parent.parent / "tasks" / "__pycache__"
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path(os.environ.get("HOME", "/"), ".cache"))
    if "NUMBA_CACHE_DIR" in os.environ or _writable(beside) or _writable(home / "numba"):
        return
    from flexroad.catalog.storage.scratch import ScratchFolder  # noqa: PLC0415 after the variables above

    # A new private folder, because numba executes the code that it reads from its cache.
    folder = ScratchFolder()
    os.environ["NUMBA_CACHE_DIR"] = folder.name
    atexit.register(folder.cleanup)


_set_numba_cache()
