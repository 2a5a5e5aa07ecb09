"""What happens to many tiles: configuration, graph, store, execution, report, command line."""

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

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
"""Environment of every process: at these sizes two BLAS threads are up to 400 times slower than one."""

# Libraries read these once, when they are imported, so it is done before any of them is. What the user
# has set stays. In a notebook NumPy is there already, and the environment is the notebook's: numba even
# refuses to go on when its number of threads changes.
if "numpy" not in sys.modules:
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _keep_compiled() -> None:
    """Give numba a folder for what it compiles, where it finds none itself and would refuse to work.

    As a service without a home that uses an installation of root's. Workers inherit it.
    """
    beside = Path(__file__).parent.parent / "tasks" / "__pycache__"
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path(os.environ.get("HOME", "/"), ".cache"))
    if "NUMBA_CACHE_DIR" in os.environ or _writable(beside) or _writable(home / "numba"):
        return
    # One of its own: what is read from there is carried out.
    os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="flexroad-")
    atexit.register(shutil.rmtree, os.environ["NUMBA_CACHE_DIR"], ignore_errors=True)


_keep_compiled()
