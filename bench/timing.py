"""Clocks of the benchmarks: CPU time of one thread, and the highest rates of one core of this machine.

CPU time is measured, not wall time, because other programs may use the machine. The lowest of several
measurements is used, because caches and clock rates only add time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import psutil

DGEMM, STREAM = 1024, 8_000_000
"""Side of the matrices, and length of the arrays (64 MB: larger than caches), that measure a core."""


@dataclass(frozen=True)
class Peak:
    """The highest rates of one core."""

    dgemm: float
    """Floating-point operations per second in a product of matrices of float64."""
    axpy: float
    """Floating-point operations per second in ``y + x`` over long arrays: bound by memory."""
    copy: float
    """Bytes read and written per second when memory is copied."""

    def __str__(self) -> str:
        return (
            f"one core: {self.dgemm / 1e9:.1f} GFlop/s (dgemm), {self.axpy / 1e9:.2f} GFlop/s (adding long "
            f"arrays), {self.copy / 1e9:.1f} GB/s (copy, read + write)"
        )


def one_thread() -> None:
    """Limit the libraries of this process to one thread, as workers do."""
    from flexroad.pipeline.execute.workers import pin_threads

    pin_threads()


def cpu_s(function: Callable[[], object], repeats: int = 7) -> float:
    """Return the lowest CPU time of several calls (s); the first call is not timed."""
    function()
    return min(one_cpu_s(function) for _ in range(repeats))


def one_cpu_s(function: Callable[[], object]) -> float:
    """Return the CPU time of one call, by this process and its threads (s)."""
    start = time.process_time()
    function()
    return time.process_time() - start


def peak() -> Peak:
    """Measure one core, after `one_thread`: a product of matrices, a sum of arrays and a copy."""
    a, b = np.random.default_rng(0).random((2, DGEMM, DGEMM))
    product = np.empty_like(a)
    x, y = np.ones((2, STREAM))
    gemm = cpu_s(lambda: np.matmul(a, b, out=product))
    add = cpu_s(lambda: np.add(x, y, out=y))
    copy = cpu_s(lambda: np.copyto(y, x))
    return Peak(2 * DGEMM**3 / gemm, STREAM / add, 2 * 8 * STREAM / copy)


def resident_mb(process: psutil.Process | None = None) -> float:
    """Return the memory of a process (MB), by default of this one; 0 if it has ended."""
    try:
        return float((process or psutil.Process()).memory_info().rss / 2**20)
    except psutil.NoSuchProcess:
        return 0.0
