"""Renders the simulated frames: scene, optics, line images, detector; in batches."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector import Detector
from compute.optics.ideal import IdealOptics
from compute.optics.line_image import line_images
from hardware.simulated.bar import PIXELS, WORKING_CENTRE_MM, sensor_bar
from hardware.simulated.settings import SimulationSettings

BATCH: Final = 8
"""Frames rendered at once; the noise of a frame depends on it, see ``FrameRenderer.batch``."""


@dataclass(frozen=True, eq=False)
class Batch:
    """BATCH consecutive exposures.

    Args:
        lines: counts, uint16, shape (BATCH, sensors, pixels), read-only.
        saturated: whether an exposure has a pixel at full scale, shape (BATCH,).
    """

    lines: NDArray[np.uint16]
    saturated: NDArray[np.bool_]


class FrameRenderer:
    """The exposures of a simulation by their number, the same whenever and in whatever order.

    Args:
        settings: the simulation.
    """

    def __init__(self, settings: SimulationSettings) -> None:
        self._settings = settings
        self._optics = IdealOptics(
            sensor_bar(),
            spot_sigma_px=settings.spot_sigma_px,
            signal_electrons=settings.signal_electrons,
            reference_distance_mm=WORKING_CENTRE_MM[2] if settings.distance_falloff else None,
        )
        self._detector = Detector(
            bits=settings.bits,
            electrons_per_count=settings.electrons_per_count,
            offset_counts=settings.offset_counts,
            read_noise_electrons=settings.read_noise_electrons,
            full_well_electrons=settings.full_well_electrons,
            ambient_electrons=settings.ambient_electrons,
        )

    def time_s(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the middle of exposures on the device's clock, same shape [s]."""
        return (sequence.astype(np.float64) + 0.5) / self._settings.frame_rate_hz

    def time_ns(self, sequence: int) -> int:
        """Return the middle of an exposure on the device's clock [ns]."""
        return round((sequence + 0.5) * 1e9 / self._settings.frame_rate_hz)

    def marker(self, sequence: int) -> int | None:
        """Return which marker an exposure lights; None: all."""
        strobed = self._settings.strobed_markers
        return sequence % strobed if strobed else None

    def signal_electrons(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the mean electrons of the markers in N exposures, shape (N, sensors, pixels)."""
        points = self._settings.scene.points(self.time_s(sequence))
        if self._settings.strobed_markers:
            lit = sequence % self._settings.strobed_markers
            points = points[np.arange(len(sequence)), lit][:, None]
        frames, markers, _ = points.shape
        spots = self._optics.spots(points.reshape(-1, 3))
        sensors = spots.position_px.shape[1]

        def by_line(values: NDArray[np.float64]) -> NDArray[np.float64]:
            per_frame = values.reshape(frames, markers, sensors)
            return per_frame.transpose(0, 2, 1).reshape(frames * sensors, markers)

        signal = line_images(
            by_line(spots.position_px), by_line(spots.sigma_px), by_line(spots.electrons), PIXELS
        )
        return signal.reshape(frames, sensors, PIXELS)

    def batch(self, number: int) -> Batch:
        """Render exposures ``BATCH * number`` to ``BATCH * (number + 1) - 1``.

        The noise is seeded by the simulation's seed and the batch's number alone.
        """
        sequence = np.arange(BATCH * number, BATCH * (number + 1), dtype=np.int64)
        seed = np.random.SeedSequence(self._settings.seed, spawn_key=(number,))
        rng = np.random.Generator(np.random.SFC64(seed))
        lines = self._detector.expose(self.signal_electrons(sequence), rng)
        lines.setflags(write=False)
        return Batch(lines, lines.max(axis=(1, 2)) == self._detector.full_scale)
