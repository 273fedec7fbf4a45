"""Cameras with a distortion unknown to their calibration, and their readings."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration
from compute.camera.field_distortion import FieldDistortion
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.mapping.measurements import MappingMeasurements
from tests.compute.rig import geometry, rig

Array = NDArray[np.float64]

MIDDLE = np.array([0.0, 0.0, 1500.0])
HALF = np.array([250.0, 250.0, 150.0])
SIGMA = 0.05


def truth(strength: float = 1.0) -> tuple[SensorModel, ...]:
    """The rig's cameras with distortion in both field angles."""
    distortion = FieldDistortion(((3, 0), (1, 2)), (-0.3 * strength, 0.2 * strength))
    return tuple(replace(model, distortion=distortion) for model in rig(3))


def places(count: int, seed: int, share: float = 1.0) -> Array:
    """Points anywhere in a box, shape (count, 3)."""
    return MIDDLE + share * HALF * np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3))


def lattice(counts: tuple[int, int, int]) -> Array:
    """Points on a grid over the box."""
    axes = [np.linspace(-1.0, 1.0, count) for count in counts]
    index = np.stack([one.ravel() for one in np.meshgrid(*axes, indexing="ij")], axis=1)
    return MIDDLE + HALF * index


def exact(models: tuple[SensorModel, ...], points: Array) -> Array:
    """Readings without noise."""
    return CameraStack.of(models).project(points)


def measure(points: Array, seed: int, sigma: float = SIGMA, strength: float = 1.0) -> Array:
    """Readings with noise of points."""
    noise = sigma * np.random.default_rng(seed).standard_normal((len(points), 3))
    return exact(truth(strength), points) + noise


def measured(
    points: Array, seed: int = 5, sigma: float = SIGMA, strength: float = 1.0
) -> MappingMeasurements:
    """Measurements of points, with their deviations."""
    readings = measure(points, seed, sigma, strength)
    return MappingMeasurements(points, readings, np.full(readings.shape, sigma))


def calibrated(what: MappingMeasurements) -> Calibration:
    """Seven parameters a camera, fitted to the measurements."""
    return calibrate(what.points_mm, what.readings_px, geometry(truth()), what.sigma_px)
