"""Device, volume, wand and frame of case wand."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import SensorGeometry, SensorModel, Vector3
from compute.camera.stack import CameraStack
from compute.optics.sensor_placement import place_sensor

Array = NDArray[np.float64]

NOISE_PX: Final = 0.1
WAND_MM: Final = 300.0
CENTRE_MM: Final = np.array([0.0, 0.0, 1500.0])
SIDE_MM: Final = 400.0
AIM_MM: Final[Vector3] = (0.0, 0.0, 1500.0)
PLACES: Final[tuple[tuple[str, Vector3, Vector3], ...]] = (
    ("vertical", (250.0, -86.0, 0.0), (0.0, 1.0, 0.0)),
    ("horizontal", (-250.0, -86.0, 0.0), (1.0, 0.0, 0.0)),
    ("rising", (291.0, 86.0, 0.0), (1.0, 1.0, 0.0)),
    ("falling", (-291.0, 86.0, 0.0), (1.0, -1.0, 0.0)),
)
"""The simulated device: lens and measured direction of each sensor (Figure 5.2, Table 5.10)."""


def device() -> tuple[SensorModel, ...]:
    """Return the four sensors, 37 mm lenses before 2048 pixels of 12 um."""
    return tuple(
        place_sensor(
            name,
            lens_position_mm=position,
            aim_mm=AIM_MM,
            measured_direction=direction,
            principal_distance_mm=37.0,
            pixels=2048,
            pitch_um=12.0,
        ).model
        for name, position, direction in PLACES
    )


def geometry(models: Sequence[SensorModel]) -> list[SensorGeometry]:
    """Return what is known of the sensors before a calibration with a frame."""
    return [SensorGeometry(model.name, model.pixels) for model in models]


def points(rng: np.random.Generator, count: int) -> Array:
    """Return points spread evenly over the volume, shape (count, 3) [mm]."""
    return CENTRE_MM + rng.uniform(-0.5 * SIDE_MM, 0.5 * SIDE_MM, (count, 3))


def wand_markers(rng: np.random.Generator, poses: int) -> Array:
    """Return the ends of a wand inside the volume, in any direction, shape (poses, 2, 3) [mm].

    Middles evenly over the volume, directions evenly over the sphere; poses that reach out of
    the volume are drawn again.
    """
    found: list[Array] = []
    while len(found) < poses:
        centre = points(rng, 1)[0]
        direction = rng.standard_normal(3)
        direction *= 0.5 * WAND_MM / np.linalg.norm(direction)
        ends = np.array([centre - direction, centre + direction])
        if (np.abs(ends - CENTRE_MM) <= 0.5 * SIDE_MM).all():
            found.append(ends)
    return np.array(found)


def readings(models: Sequence[SensorModel], places_mm: Array, rng: np.random.Generator) -> Array:
    """Return noisy readings of places (..., 3), shape (..., S) [px]."""
    exact = CameraStack.of(models).project(places_mm.reshape(-1, 3))
    noisy: Array = exact + NOISE_PX * rng.standard_normal(exact.shape)
    return noisy.reshape(*places_mm.shape[:-1], len(models))


def wrong_start(
    models: Sequence[SensorModel], share: float, rng: np.random.Generator
) -> tuple[SensorModel, ...]:
    """Return cameras that are wrong in everything, evenly up to a share.

    The principal distance by the share of itself, the principal point of half the pixels, each
    coordinate of the lens of 300 mm (half the device), and turns of 0.3 rad about each axis.
    """
    found = []
    for model in models:
        lens = -model.offset_x_mm * model.rotation[0] - model.offset_z_mm * model.rotation[2]
        off = rng.uniform(-share, share, 8)
        rotation = Rotation.from_rotvec(0.3 * off[:3]).as_matrix() @ model.rotation
        offset = -rotation @ (lens + 300.0 * off[3:6])
        x, y, z = Rotation.from_matrix(rotation).as_rotvec().tolist()
        found.append(
            replace(
                model,
                principal_distance_px=model.principal_distance_px * (1.0 + float(off[6])),
                principal_point_px=model.principal_point_px + 0.5 * model.pixels * float(off[7]),
                rotation_vector_rad=(x, y, z),
                offset_x_mm=float(offset[0]),
                offset_z_mm=float(offset[2]),
            )
        )
    return tuple(found)


def aligned_errors(found_mm: Array, true_mm: Array) -> Array:
    """Return found less true points after the best rigid motion, shape (N, 3) [mm]."""
    away = found_mm - found_mm.mean(axis=0)
    expected = true_mm - true_mm.mean(axis=0)
    left, _, right = np.linalg.svd(expected.T @ away)
    flip = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(left @ right)))])
    errors: Array = away @ (left @ flip @ right).T - expected
    return errors
