"""TrackOptics: what the detectors behind a plate's tracks collect of a light line."""

import numpy as np
from numpy.typing import NDArray

from compute.optics.coded_aperture.gray_plate import GrayPlate
from compute.optics.pixel_solid_angles import PixelSolidAngles, SolidAngleOptics

Array = NDArray[np.float64]


class TrackOptics:
    """Line optics in front of plates with tracks, one plate for each sensor.

    Args:
        lines: the line optics, on a row of pixels that are the steps of the plate, as high as a
            track.
        plate: the plate.
    """

    def __init__(self, lines: SolidAngleOptics, plate: GrayPlate) -> None:
        self._lines = lines
        steps = np.arange(2**plate.bits)
        # Step by step and not cell by cell: a line's window begins at any step.
        self._passes = plate.transparent[steps // 2**plate.analogue_bits].astype(np.float64)
        # Two steps of darkness, one at either end, stand for all that falls beside the plate.
        self._passes = np.pad(self._passes, ((1, 1), (0, 0)))

    def solid_angles(self, points_mm: Array) -> PixelSolidAngles:
        """Return footprints of points (N, 3) in the world frame [mm]; pixels are the detectors."""
        lines = self._lines.solid_angles(points_mm)
        window = lines.solid_angle_sr.shape[2]
        step = lines.first_px[..., None] + np.arange(window)
        rows = np.clip(step, -1, len(self._passes) - 2) + 1
        collected = np.einsum("nsw,nswt->nst", lines.solid_angle_sr, self._passes[rows])
        return PixelSolidAngles(np.zeros(lines.first_px.shape, dtype=np.int64), collected)
