"""Random generators and smooth random fields that depend only on seed and location."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from flexroad.tasks.types import Floats

KEY_OFFSET = 2**31
"""Added to lattice indices, because seeds must not be negative."""


def generator(seed: int, purpose: str, *key: int) -> np.random.Generator:
    """Return the random generator of one object of the world; it is the same for every tile."""
    return np.random.default_rng([seed, zlib.crc32(purpose.encode()), *(k + KEY_OFFSET for k in key)])


@dataclass(frozen=True, eq=False)
class Waves:
    """A smooth field: a sum of plane waves of several lengths and directions.

    It is defined everywhere, so tiles that are evaluated separately join without a step.
    """

    wavevectors: Floats
    """``(K, 2)``, rad/m along x and y."""
    phases: Floats
    """``(K,)``, rad."""
    amplitudes: Floats
    """``(K,)``, m."""

    def __call__(self, x: Floats, y: Floats) -> Floats:
        """Return the field (m) at the points, in their broadcast shape."""
        total = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
        for (kx, ky), phase, amplitude in zip(self.wavevectors, self.phases, self.amplitudes, strict=True):
            total += amplitude * np.sin(kx * x + ky * y + phase)
        return total


def field(seed: int, purpose: str, span_m: tuple[float, float], number: int, rms_m: float = 1.0) -> Waves:
    """Return a field of a root mean square: waves of equal amplitude from the shortest to the longest."""
    lengths = np.geomspace(*span_m, number)
    return waves(generator(seed, purpose), lengths, rms_m * np.sqrt(2 / number))


def waves(rng: np.random.Generator, lengths_m: ArrayLike, amplitudes_m: ArrayLike) -> Waves:
    """Return waves of the given lengths and amplitudes with random directions and phases."""
    lengths, amplitudes = np.broadcast_arrays(
        np.asarray(lengths_m, np.float64), np.asarray(amplitudes_m, np.float64)
    )
    heading = rng.uniform(0, 2 * np.pi, lengths.size)
    wavevectors = (2 * np.pi / lengths)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return Waves(wavevectors, rng.uniform(0, 2 * np.pi, lengths.size), amplitudes)
