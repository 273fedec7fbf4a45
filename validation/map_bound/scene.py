"""The bar of Figure 5.2 with the stopped-down lens: simulated scans and their readings."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from compute.camera.model import SensorGeometry
from compute.optics.detector import Detector
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_loader import load_profile
from compute.planning.cramer_rao import shifted_stripes
from compute.planning.planning_device import PlanningDevice, planning_device
from compute.signal.cramer_rao import position_bound
from validation.aberrations.thesis_lens import stopped_lens

Array = NDArray[np.float64]

STOP_MM: Final = 4.0
LOW_MM: Final = (-650.0, -650.0, 1500.0)
HIGH_MM: Final = (650.0, 650.0, 1900.0)
"""The full field of the sensors of Figure 5.2, in the frame of the profile thesis-5.2."""
RIM: Final = 0.1
_BLOCK: Final = 64


@dataclass(frozen=True, eq=False)
class Readings:
    """What S sensors read of N markers; NaN where a sensor does not see one whole.

    Args:
        points_mm: shape (N, 3) [mm].
        exact_px: centres of gravity of the lines without noise, shape (N, S) [px].
        position_px: those of the exposed lines, shape (N, S) [px].
        sigma_px: their standard deviations by the pixels' noise, shape (N, S) [px].
        bound_px: the Cramer-Rao bound of the same lines, shape (N, S) [px].
    """

    points_mm: Array
    exact_px: Array
    position_px: Array
    sigma_px: Array
    bound_px: Array

    @property
    def sensors(self) -> NDArray[np.intp]:
        """How many sensors read each point, shape (N,)."""
        count: NDArray[np.intp] = np.isfinite(self.position_px).sum(axis=1)
        return count

    def of(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> "Readings":
        """Return some of the points."""
        return Readings(*(getattr(self, name)[rows] for name in vars(self)))

    def and_(self, others: "Readings") -> "Readings":
        """Return these points and others."""
        return Readings(
            *(np.concatenate([getattr(one, name) for one in (self, others)]) for name in vars(self))
        )

    def drawn(self, rng: np.random.Generator) -> "Readings":
        """Return other exposures: the exact readings with normal errors of the same deviations."""
        noise = self.sigma_px * rng.standard_normal(self.sigma_px.shape)
        return replace(self, position_px=self.exact_px + noise)


@dataclass(frozen=True, eq=False)
class Scene:
    """A device and how its lines are exposed and searched.

    Args:
        device: optics, light and noise.
        detector: nominal pixels, one like the other, as after a flat-field correction.
    """

    device: PlanningDevice
    detector: Detector

    @classmethod
    def of(cls, profile: DeviceProfile) -> "Scene":
        """Return the scene of a device's profile."""
        detector = replace(
            profile.detector.detector(profile.rates.exposure_s),
            response_nonuniformity=0.0,
            dark_nonuniformity=0.0,
            offset_nonuniformity_counts=0.0,
        )
        return cls(planning_device(profile), detector)

    @property
    def geometry(self) -> tuple[SensorGeometry, ...]:
        """What is known of the sensors before calibration."""
        row = self.device.lenses[0][0].row
        return tuple(SensorGeometry(name, row.count, row.pitch_um) for name in self.device.names)

    def read(self, points_mm: Array, rng: np.random.Generator) -> Readings:
        """Trace, expose and read the lines of points (N, 3), one exposure each."""
        parts = [
            self._read(points_mm[start : start + _BLOCK], rng)
            for start in range(0, len(points_mm), _BLOCK)
        ]
        return Readings(points_mm, *(np.concatenate(one) for one in zip(*parts, strict=True)))

    def _read(
        self, points_mm: Array, rng: np.random.Generator
    ) -> tuple[Array, Array, Array, Array]:
        device, pixels = self.device, self.device.pixels
        shapes = [
            lines.shapes(sensor.to_sensor_frame(points_mm)) for sensor, lines in device.lenses
        ]
        light = device.electrons_per_sr(points_mm)
        exact, position, sigma = (np.full(light.shape, np.nan) for _ in range(3))
        for sensor, shape in enumerate(shapes):
            mean = shape.pixels_sr * light[:, sensor, None]
            pixel = shape.first_px[:, None] + np.arange(mean.shape[1])
            # A line that the row's end cuts has its centre elsewhere; a full pixel, too.
            lit = mean > _DARK * mean.max(axis=1, keepdims=True)
            fit = (~lit | ((pixel >= 0) & (pixel < pixels))).all(axis=1)
            fit &= (mean.max(axis=1) < device.full_electrons * _FULL) & (mean.sum(axis=1) > 0.0)
            exact[fit, sensor] = shape.centroid_px[fit]
            position[fit, sensor], sigma[fit, sensor] = self._centroids(
                mean[fit], pixel[fit], lit[fit], rng
            )
        lines = shifted_stripes(shapes, pixels)
        bound = position_bound(
            lines.mean_sr * light[..., None],
            lines.slope_sr_per_px * light[..., None],
            device.noise.variance_electrons2,
        )
        return exact, position, sigma, np.where(np.isfinite(position), bound, np.nan)

    def _centroids(
        self,
        mean_electrons: Array,
        place_px: NDArray[np.int64],
        lit: NDArray[np.bool_],
        rng: np.random.Generator,
    ) -> tuple[Array, Array]:
        """Expose lines once; return their centres of gravity and these' deviations, (N,) [px].

        Over the pixels that the line lights, as where it is expected is known to a pixel or so;
        what it weighs is above the dark signal, with no threshold that would cut it askew.
        """
        detector, noise = self.detector, self.device.noise
        counts = detector.expose(mean_electrons, rng).astype(np.float64)
        dark = detector.ambient_electrons + detector.dark_electrons
        signal = (counts - detector.offset_counts) * detector.electrons_per_count - dark
        weight = np.where(lit, signal, 0.0)
        total = weight.sum(axis=1)
        centre = (weight * place_px).sum(axis=1) / total
        variance = np.where(lit, np.maximum(signal, 0.0) + noise.variance_electrons2, 0.0)
        spread = (variance * (place_px - centre[:, None]) ** 2).sum(axis=1)
        return centre, np.sqrt(spread) / total


_DARK: Final = 1e-3
"""Pixels with less of the brightest one's light are not the line's."""
_FULL: Final = 0.9


def bar_scene() -> Scene:
    """Return the four sensors of Figure 5.2 behind the lens of section 3.4 stopped to 4 mm."""
    profile = load_profile("thesis-5.2")
    return Scene.of(replace(profile, optics={"main": stopped_lens(STOP_MM)}))


def random_points_in_box(count: int, low_mm: Array, high_mm: Array, seed: int) -> Array:
    """Return points spread evenly over a box, those at its rim on its faces, (count, 3) [mm].

    A scrambled Sobol sequence over a box RIM larger; whoever maps a volume goes to its ends.
    """
    power = int(np.ceil(np.log2(count)))
    positions = qmc.Sobol(3, seed=seed).random_base2(power)[:count]
    share = np.clip((positions - 0.5) * (1.0 + RIM) + 0.5, 0.0, 1.0)
    points: Array = low_mm + share * (np.asarray(high_mm) - low_mm)
    return points
