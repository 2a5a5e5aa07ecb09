"""What happens to many tiles: configuration, graph, store, execution, report, command line."""

import os

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
# has set stays.
for name, value in ONE_THREAD.items():
    os.environ.setdefault(name, value)
