"""Comatic stripes on a sensor: an asymmetric light integrated over pixels, noise and its bound.

Written from the physics alone, without any code of the project: the stripe is an exponentially
modified Gaussian (a Gaussian blur of an exponential flare). Its skewness changes along the sensor.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import exponnorm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ComaticSensor:
    """A sensor of N pixels; the flare at its ends is ``flare`` of the stripe's blur, outwards."""

    pixels: int = 512
    blur_px: float = 1.0
    flare: float = 1.0
    electrons_per_count: float = 10.0
    read_electrons: float = 20.0
    offset_counts: float = 100.0

    def shares(self, position_px: float) -> Array:
        """Return the shares of the light in the pixels; the centre of gravity is the position."""
        return self._shifted(position_px, 0.0)

    def expected(self, position_px: float, light: float, ambient: float) -> Array:
        """Return the mean electrons of the pixels."""
        return light * self.shares(position_px) + ambient

    def expose(
        self, position_px: Array, light: float, ambient: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Return the counts of one exposure at each position, shape (F, N)."""
        scans = np.empty((len(position_px), self.pixels))
        for row, position in zip(scans, position_px, strict=True):
            row[:] = rng.poisson(self.expected(float(position), light, ambient))
        scans += self.read_electrons * rng.standard_normal(scans.shape)
        counts = np.rint(scans / self.electrons_per_count + self.offset_counts)
        return np.clip(counts, 0, 65535).astype(np.uint16)

    def bound_px(self, position_px: float, light: float, ambient: float) -> float:
        """Return the Cramer-Rao bound of a position; light and a level are unknown, too.

        The shape counts as known at the position: its change along the sensor is no information.
        """
        step = 1e-3
        here = self.shares(position_px)
        # Shifted, not deformed: by a fine grid of the same stripe.
        by_position = (self._shifted(position_px, step) - self._shifted(position_px, -step)) / (
            2.0 * step
        )
        variance = (
            light * here + ambient + self.read_electrons**2 + self.electrons_per_count**2 / 12.0
        )
        jacobian = np.stack([light * by_position, here, np.ones(self.pixels)])
        near = np.abs(np.arange(self.pixels) - position_px) < 40
        jacobian, variance = jacobian[:, near], variance[near]
        return float(np.sqrt(np.linalg.inv((jacobian / variance) @ jacobian.T)[0, 0]))

    def _shifted(self, position_px: float, by: float) -> Array:
        """Return the shares of the stripe of a position that is moved without another shape."""
        field = 2.0 * position_px / (self.pixels - 1.0) - 1.0
        tail = max(self.flare * abs(field), 1e-3)
        sign = 1.0 if field >= 0.0 else -1.0
        # exponnorm has its Gaussian at zero; its mean is the flare's.
        edges = sign * (np.arange(self.pixels + 1) - 0.5 - position_px - by)
        below = exponnorm.cdf(edges, tail, loc=-tail * self.blur_px, scale=self.blur_px)
        return np.abs(np.diff(below))
