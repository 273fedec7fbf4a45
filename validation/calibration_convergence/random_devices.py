"""Random devices of case calibration-convergence, and wrong starts."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.field_distortion import FieldDistortion, symmetric_terms
from compute.camera.model import SensorGeometry, SensorModel, vector3
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

SENSORS: Final = 4
PIXELS: Final = 2048
PITCH_UM: Final = 12.0
START_ERROR: Final = 0.3
"""How wrong a starting value is at most: of itself, or, of an angle, of a radian."""
MIN_POINTS_PER_SENSOR: Final = 12
"""Points that each sensor sees at least."""


@dataclass(frozen=True, eq=False)
class Device:
    """A random device with its control points.

    Args:
        models: the true cameras.
        points_mm: shape (N, 3).
        readings_px: with noise, shape (N, S); NaN where not seen.
        sigma_px: deviation of the noise.
        start: starting values up to 30 % wrong.
    """

    models: tuple[SensorModel, ...]
    points_mm: Array
    readings_px: Array
    sigma_px: float
    start: tuple[SensorModel, ...]

    @property
    def geometry(self) -> list[SensorGeometry]:
        """What is known of the sensors."""
        return [SensorGeometry(model.name, model.pixels, PITCH_UM) for model in self.models]


def random_device(rng: np.random.Generator, distorted: bool = False) -> Device:
    """Draw four sensors 1 to 2 m from 19 to 40 points in a box of 0.2 to 0.6 m, and noise.

    The noise is 0.02 to 2 px, principal distances are 1500 to 4500 px, slits lie at any angle.
    With distortion there are 60 to 120 points over the field, and 0.02 to 0.2 px of noise.
    """
    while True:
        models = tuple(_camera(f"s{number + 1}", rng, distorted) for number in range(SENSORS))
        count = int(rng.integers(60, 121) if distorted else rng.integers(19, 41))
        half = rng.uniform(350.0, 450.0, 3) if distorted else rng.uniform(100.0, 300.0, 3)
        points = rng.uniform(-1.0, 1.0, (count, 3)) * half
        low, high = (0.02, 0.2) if distorted else (0.02, 2.0)
        sigma = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        readings = CameraStack.of(models).project(points)
        readings = readings + sigma * rng.standard_normal(readings.shape)
        inside = (readings >= -0.5) & (readings <= PIXELS - 0.5)
        if inside.sum(axis=0).min() >= (40 if distorted else MIN_POINTS_PER_SENSOR):
            break
    start = tuple(wrong_start(model, rng) for model in models)
    return Device(models, points, np.where(inside, readings, np.nan), sigma, start)


def _camera(name: str, rng: np.random.Generator, distorted: bool) -> SensorModel:
    distance = rng.uniform(1000.0, 2000.0)
    position = np.array([*rng.uniform(-0.4, 0.4, 2) * distance, -distance])
    view = rng.uniform(-0.05, 0.05, 3) * distance - position
    view /= np.linalg.norm(view)
    side = np.cross([0.0, 1.0, 0.0], view)
    side /= np.linalg.norm(side)
    slit = rng.uniform(0.0, np.pi)
    along = np.cos(slit) * side + np.sin(slit) * np.cross(view, side)
    rotation = np.array([along, np.cross(view, along), view])
    x, y, z = -rotation @ position
    c = rng.uniform(1500.0, 4500.0)
    lens = None
    if distorted:
        c = rng.uniform(2000.0, 3000.0)
        terms = symmetric_terms(3)
        values = tuple(rng.uniform(-0.4, 0.4, len(terms)).tolist())
        lens = FieldDistortion(terms, values, float(y), 1e-3 * PITCH_UM * c)
    vector = vector3(Rotation.from_matrix(rotation).as_rotvec())
    p0 = rng.uniform(824.0, 1224.0)
    return SensorModel(name, PIXELS, c, p0, vector, float(x), float(z), distortion=lens)


def wrong_start(model: SensorModel, rng: np.random.Generator) -> SensorModel:
    """Return a starting value of a camera that is wrong by up to START_ERROR."""
    c, p0, x, z = 1.0 + START_ERROR * rng.uniform(-1.0, 1.0, 4)
    turn = Rotation.from_rotvec(START_ERROR * rng.uniform(-1.0, 1.0, 3))
    turned = turn * Rotation.from_rotvec(model.rotation_vector_rad)
    return replace(
        model,
        principal_distance_px=model.principal_distance_px * float(c),
        principal_point_px=model.principal_point_px * float(p0),
        rotation_vector_rad=vector3(turned.as_rotvec()),
        offset_x_mm=model.offset_x_mm * float(x),
        offset_z_mm=model.offset_z_mm * float(z),
        distortion=None,
    )
