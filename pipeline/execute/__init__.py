"""Run jobs one after the other or on Dask; the only package that knows Dask.

One Dask task is one tile: its graph is pulled inside a single process, so that no raster ever travels
(``docs/decisions.md`` has the measurement against one task per stage).
"""

from flexroad.pipeline.execute.dask import DaskExecutor
from flexroad.pipeline.execute.executor import Executor
from flexroad.pipeline.execute.serial import SerialExecutor

__all__ = ["DaskExecutor", "Executor", "SerialExecutor"]
