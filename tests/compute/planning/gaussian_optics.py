"""PixelSolidAngles of ideal lenses with Gaussian lines, whose bound is known by calculus."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.optics.pixel_solid_angles import PixelSolidAngles

WIDTH = 41


class GaussianOptics:
    """Lines of deviation ``sigma_px``, 1 sr in all, where the camera model says."""

    def __init__(self, models: Sequence[SensorModel], sigma_px: float) -> None:
        self.cameras = CameraStack.of(models)
        self.sigma_px = sigma_px

    def solid_angles(self, points_mm: NDArray[np.float64]) -> PixelSolidAngles:
        position = self.cameras.project(points_mm)
        lit = np.isfinite(position)
        centre = np.where(lit, position, 0.0)
        first = np.rint(centre).astype(np.int64) - WIDTH // 2
        edges = first[..., None] + np.arange(WIDTH + 1) - 0.5
        share = np.diff(ndtr((edges - centre[..., None]) / self.sigma_px), axis=-1)
        return PixelSolidAngles(first, share * lit[..., None])
