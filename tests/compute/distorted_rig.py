"""The rig with lenses that distort by both field angles, and points over their whole field."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.camera.field_distortion import FieldDistortion, Term
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from tests.compute.rig import rig

Array = NDArray[np.float64]

PITCH_UM = 12.0
MIDDLE_MM = np.array([0.0, 0.0, 1500.0])


def distorted_rig(terms: tuple[Term, ...], seed: int = 0) -> tuple[SensorModel, ...]:
    """The rig with some pixels of distortion, its lenses aimed a few degrees beside the middle."""
    rng = np.random.default_rng(seed)
    models = []
    for model in rig():
        # About what a third-order lens has: 0.1 to 0.3 in each term of the third order.
        coefficients = [rng.uniform(0.1, 0.3) * 0.5 ** max(sum(term) - 3, 0) for term in terms]
        offset = -float((model.rotation @ MIDDLE_MM)[1]) + rng.uniform(-60.0, 60.0)
        behind = 1e-3 * PITCH_UM * model.principal_distance_px
        distortion = FieldDistortion(terms, tuple(coefficients), offset, behind)
        models.append(replace(model, distortion=distortion))
    return tuple(models)


def field_points(count: int, seed: int = 1) -> Array:
    """Points over about 20 degrees to each side."""
    rng = np.random.default_rng(seed)
    return MIDDLE_MM + rng.uniform(-1.0, 1.0, (count, 3)) * [480.0, 480.0, 250.0]


def geometry_with_pitch(models: tuple[SensorModel, ...]) -> list[SensorGeometry]:
    """What is known of the sensors before calibration."""
    return [SensorGeometry(model.name, model.pixels, PITCH_UM) for model in models]


def seen_readings(models: tuple[SensorModel, ...], points: Array) -> Array:
    """Exact readings, NaN beyond the pixels, shape (N, S)."""
    readings = CameraStack.of(models).project(points)
    inside = (readings >= -0.5) & (readings <= models[0].pixels - 0.5)
    return np.where(inside, readings, np.nan)
