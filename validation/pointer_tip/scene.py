"""The Optotrak's sensors, a pointer, its motion and its readings."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.optics.profiles.profile_loader import load_profile
from compute.planning.coverage import is_visible
from compute.signal.cramer_rao import position_bound
from compute.transform import rotation_matrix
from validation.map_bound.optotrak import CONTROL, RESOLUTION_MM, fit_scale
from validation.map_bound.point_errors import fit, mapped
from validation.map_bound.scene import Readings, Scene, random_points_in_box

Array = NDArray[np.float64]

MARKERS_MM: Final = np.array(
    [[-35.0, 0.0, 0.0], [35.0, 0.0, 0.0], [0.0, 0.0, 60.0], [0.0, 25.0, 25.0]]
)
TIP_MM: Final = np.array([0.0, 0.0, -150.0])
CUBE_MM: Final = 500.0
FRAME_S: Final = 1e-3
TILT_RAD: Final = 0.8
"""Most turn of the pointer from upright: its markers face the sensors."""
_BLOCK: Final = 128
_UPRIGHT: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""The pointer's axis along the world's Y, its flat side to the sensors."""


@dataclass(frozen=True, eq=False)
class Stroke:
    """A pointer that is moved evenly.

    Args:
        rotation: R_world_tool at the first instant.
        place_mm: of the tip at the first instant.
        velocity_mm_s: of the tip.
        angular_velocity_rad_s: about the world's axes.
    """

    rotation: Array
    place_mm: Array
    velocity_mm_s: Array
    angular_velocity_rad_s: Array

    def tip_mm(self, exposure: int) -> Array:
        """Return where the tip is, shape (3,)."""
        return self.place_mm + self.velocity_mm_s * FRAME_S * exposure

    def markers_mm(self, exposure: int) -> Array:
        """Return where the markers are, shape (M, 3)."""
        turned = rotation_matrix(self.angular_velocity_rad_s * FRAME_S * exposure) @ self.rotation
        return np.asarray((MARKERS_MM - TIP_MM) @ turned.T + self.tip_mm(exposure))


def random_strokes(count: int, rng: np.random.Generator) -> list[Stroke]:
    """Return strokes with their tips anywhere in the cube, moved by a hand in any direction."""
    centre = np.array(load_profile("optotrak").volume.centre_mm)
    return [
        Stroke(
            rotation_matrix(rng.uniform(-TILT_RAD, TILT_RAD, 3)) @ _UPRIGHT,
            centre + rng.uniform(-0.5, 0.5, 3) * CUBE_MM,
            150.0 * _direction(rng) * rng.uniform(),
            1.0 * _direction(rng) * rng.uniform(),
        )
        for _ in range(count)
    ]


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True, eq=False)
class Laboratory:
    """Sensors that read, and what is known of them.

    Args:
        scene: the profile's device.
        model: cameras, their covariance and their table, as a tracker knows them.
        sigma_px: deviation of all readings; None: each has its line's Cramer-Rao bound.
        traced: readings are traced through the lenses; else they are the model's.
        median_sigma_px: of the control points' readings.
    """

    scene: Scene
    model: MeasurementModel
    sigma_px: float | None
    traced: bool
    median_sigma_px: float

    def read(self, points_mm: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return readings and their deviations of points (N, 3), shapes (N, S) [px]."""
        exact, sigma = simulate_readings(self.scene, points_mm, self.sigma_px)
        if not self.traced:
            exact = np.where(np.isfinite(exact), self.model.linearise(points_mm)[0], np.nan)
        return exact + sigma * rng.standard_normal(exact.shape), sigma


@cache
def _scene() -> Scene:
    return Scene.of(load_profile("optotrak"))


@cache
def laboratory(*, published: bool, calibrated: bool) -> Laboratory:
    """Return the sensors, calibrated and mapped at a noise.

    Args:
        published: the noise is the published resolution at 2.25 m; else each line's own bound.
        calibrated: readings are traced, cameras and table have the errors that they have; else
            the cameras are known exactly: they are the calibrated ones, which readings obey.
    """
    profile = load_profile("optotrak")
    scene = _scene()
    centre, size = np.array(profile.volume.centre_mm), np.array(profile.volume.size_mm)
    low, high = centre - size / 2.0, centre + size / 2.0
    sigma_px = RESOLUTION_MM * fit_scale(scene, low, high) if published else None
    points = random_points_in_box(CONTROL * 3 // 2, low, high, 5)
    exact, sigma = simulate_readings(scene, points, sigma_px)
    control = Readings(points, exact, exact, sigma, sigma).drawn(np.random.default_rng(7))
    control = control.of(np.flatnonzero(control.sensors == len(scene.device.names))[:CONTROL])
    one = mapped(fit(control, scene.geometry, "auto"), control)
    assert one.mapping is not None
    # The table's variance holds the cameras' own.
    model = MeasurementModel(one.cameras, None, one.mapping.table if calibrated else None)
    return Laboratory(scene, model, sigma_px, calibrated, float(np.nanmedian(control.sigma_px)))


def simulate_readings(
    scene: Scene, points_mm: Array, sigma_px: float | None
) -> tuple[Array, Array]:
    """Return exact readings and their deviations of points (N, 3), shapes (N, S); NaN unseen."""
    device = scene.device
    exact, deviation = [], []
    for start in range(0, len(points_mm), _BLOCK):
        part = points_mm[start : start + _BLOCK]
        look = device.image_points(part)
        sees = is_visible(look.readings_px, device.pixels, look.light_sr)
        exact.append(np.where(sees, look.readings_px, np.nan))
        if sigma_px is None:
            assert look.lines is not None
            light = device.electrons_per_sr(part)[..., None]
            bound = position_bound(
                look.lines.mean_sr * light,
                look.lines.slope_sr_per_px * light,
                device.noise.variance_electrons2,
            )
        else:
            bound = np.full(sees.shape, sigma_px)
        deviation.append(np.where(sees, bound, np.nan))
    return np.concatenate(exact), np.concatenate(deviation)
