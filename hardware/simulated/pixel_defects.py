"""PixelDefects: how the pixels of the simulated sensors differ; a detector with bad pixels."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from compute.optics.detector import Detector
from compute.optics.detector_array import DetectorArray
from hardware.field_bounds import CheckedSettings

Count = Annotated[int, Field(ge=0, le=64)]

_STUCK_FRACTION = 0.25  # of full scale


@dataclass(frozen=True)
class PixelDefects(CheckedSettings):
    """Differences of the pixels and bad pixels, drawn for each sensor from a seed.

    Args:
        response_nonuniformity: relative standard deviation of the response (PRNU).
        offset_nonuniformity_counts: standard deviation of the offset (DSNU) [counts].
        dead_pixels: pixels of each sensor that see no light.
        hot_pixels: pixels of each sensor with a dark signal of ``hot_electrons``.
        stuck_pixels: pixels of each sensor that always read a quarter of full scale.
        hot_electrons: mean electrons that a hot pixel collects without light.
        seed: another device has another.

    Raises:
        InvalidParameter: a value is outside of its bounds.
    """

    response_nonuniformity: Annotated[float, Field(ge=0.0, le=0.2)] = 0.01
    offset_nonuniformity_counts: Annotated[float, Field(ge=0.0, le=30.0)] = 2.0
    dead_pixels: Count = 1
    hot_pixels: Count = 1
    stuck_pixels: Count = 1
    hot_electrons: Annotated[float, Field(ge=0.0, le=1e6)] = 3000.0
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 1

    def positions(self, sensors: int, pixels: int) -> tuple[NDArray[np.intp], ...]:
        """Return the dead, hot and stuck pixels, each as indices of shape (S, count)."""
        defects = []
        for sensor in range(sensors):
            seeds = np.random.SeedSequence(self.seed, spawn_key=(sensor, 3))
            rng = np.random.default_rng(seeds)
            bad = self.dead_pixels + self.hot_pixels + self.stuck_pixels
            defects.append(rng.permutation(pixels)[:bad])
        ends = np.cumsum([self.dead_pixels, self.hot_pixels])
        return tuple(np.split(np.array(defects, dtype=np.intp).reshape(sensors, -1), ends, axis=1))


class DefectiveDetector:
    """A detector array some pixels of which are dead, hot or stuck.

    Args:
        detector: the pixels' nominal parameters.
        sensors: S.
        pixels: P of each.
        defects: how they differ.
    """

    def __init__(
        self, detector: Detector, sensors: int, pixels: int, defects: PixelDefects
    ) -> None:
        self._detector = detector
        self._array = DetectorArray(detector, sensors, pixels, pattern_seed=defects.seed)
        self._defects = defects
        self._dead, self._hot, self._stuck = defects.positions(sensors, pixels)
        self._row = np.arange(sensors)[:, None]

    def expose(
        self, signal_electrons: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Return the counts of exposures; see ``DetectorArray.expose``."""
        detector, row = self._detector, self._row
        counts = self._array.expose(signal_electrons, rng)
        offset = self._array.pattern.offset_counts[row, self._dead]
        shape = (*counts.shape[:-2], *self._dead.shape)
        noise = detector.read_noise_electrons * rng.standard_normal(shape)
        counts[..., row, self._dead] = detector.convert(noise, np.broadcast_to(offset, shape))
        hot = rng.poisson(self._defects.hot_electrons, (*counts.shape[:-2], *self._hot.shape))
        warm = counts[..., row, self._hot] + np.floor(hot / detector.electrons_per_count)
        counts[..., row, self._hot] = np.minimum(warm, detector.full_scale).astype(np.uint16)
        counts[..., row, self._stuck] = int(_STUCK_FRACTION * detector.full_scale)
        return counts
