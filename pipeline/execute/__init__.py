"""Executors: run jobs one after the other, on Dask, or on Dask only if that saves time.

The only package that imports Dask.

One Dask task is one tile. Its graph is computed inside a single process, so that no raster is sent between
processes (``docs/decisions.md`` has the measurement against one task per stage).
"""

from flexroad.pipeline.execute.dask import DaskExecutor
from flexroad.pipeline.execute.executor import AdaptiveExecutor, Executor, Jobs, SerialExecutor

__all__ = ["AdaptiveExecutor", "DaskExecutor", "Executor", "Jobs", "SerialExecutor"]
