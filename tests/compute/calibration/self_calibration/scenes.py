"""Wands and bodies in a volume of 400 mm in front of the rig."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.self_calibration.result import SelfCalibration
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import reconstruct
from tests.compute.rig import rig

Array = NDArray[np.float64]

SIGMA_PX = 0.1
MIDDLE = np.array([0.0, 0.0, 1500.0])
HALF_MM = 200.0
WAND_MM = 300.0
BODY = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 70.0, 0.0], [20.0, 30.0, 60.0]])


def noisy(models: tuple[SensorModel, ...], markers: Array, rng: np.random.Generator) -> Array:
    """Readings of markers (B, K, 3), shape (B, K, S)."""
    exact = CameraStack.of(models).project(markers.reshape(-1, 3))
    exact = exact.reshape(*markers.shape[:2], len(models))
    return exact + SIGMA_PX * rng.standard_normal(exact.shape)


def wand_markers(poses: int, rng: np.random.Generator, half_mm: float = HALF_MM) -> Array:
    """Ends of bars in any direction, wholly inside the volume, shape (poses, 2, 3)."""
    found: list[Array] = []
    while len(found) < poses:
        direction = rng.standard_normal(3)
        direction *= 0.5 * WAND_MM / np.linalg.norm(direction)
        middle = rng.uniform(-half_mm, half_mm, 3)
        if (np.abs(middle) + np.abs(direction) <= half_mm).all():
            found.append(MIDDLE + np.array([middle - direction, middle + direction]))
    return np.array(found)


def bars(middles: Array, directions: Array) -> Array:
    """Ends of bars, shape (B, 2, 3)."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.stack([middles - 0.5 * WAND_MM * unit, middles + 0.5 * WAND_MM * unit], axis=1)


def body_markers(
    body: Array, poses: int, rng: np.random.Generator, half_mm: float = 100.0
) -> tuple[Array, Array, Array]:
    """Markers of a body at random poses (poses, K, 3), with rotations and translations."""
    rotation = Rotation.random(poses, rng=rng).as_matrix()
    translation = MIDDLE + rng.uniform(-half_mm, half_mm, (poses, 3))
    markers = np.einsum("bij,kj->bki", rotation, body) + translation[:, None]
    return markers, rotation, translation


def wrong_by(
    models: tuple[SensorModel, ...], share: float, rng: np.random.Generator
) -> tuple[SensorModel, ...]:
    """Cameras that are wrong by up to a share: c, p0 of 1024 px, lens of 300 mm, 0.3 rad."""
    found = []
    for model in models:
        off = rng.uniform(-share, share, 8)
        lens = -model.offset_x_mm * model.rotation[0] - model.offset_z_mm * model.rotation[2]
        rotation = Rotation.from_rotvec(0.3 * off[:3]).as_matrix() @ model.rotation
        offset = -rotation @ (lens + 300.0 * off[3:6])
        x, y, z = Rotation.from_matrix(rotation).as_rotvec().tolist()
        found.append(
            replace(
                model,
                principal_distance_px=model.principal_distance_px * (1.0 + float(off[6])),
                principal_point_px=model.principal_point_px + 1024.0 * float(off[7]),
                rotation_vector_rad=(x, y, z),
                offset_x_mm=float(offset[0]),
                offset_z_mm=float(offset[2]),
            )
        )
    return tuple(found)


def point_errors(
    found: SelfCalibration,
    rng: np.random.Generator,
    models: tuple[SensorModel, ...] | None = None,
    frame: tuple[Array, Array] | None = None,
) -> tuple[float, float]:
    """RMS error of 500 independent points [mm] and their mean normalised error squared.

    ``frame``: rotation and translation of the result's frame in the rig's.
    """
    true = models or rig()
    points = MIDDLE + rng.uniform(-HALF_MM, HALF_MM, (500, 3))
    read = noisy(true, points[:, None], rng)[:, 0]
    if frame is not None:
        rotation, translation = frame
        points = (points - translation) @ rotation
    covariance = np.array(found.calibration.covariance)
    sigma = np.full(len(true), SIGMA_PX)
    batch = reconstruct(found.calibration.models, read, sigma, covariance)
    away = batch.position_mm - points
    inverse = np.linalg.inv(batch.covariance_mm2)
    nees = float(np.einsum("ni,nij,nj->n", away, inverse, away).mean())
    return float(np.sqrt((away**2).sum(axis=1).mean())), nees


def distances_kept(found: SelfCalibration, rng: np.random.Generator) -> float:
    """RMS error of distances between 200 independent pairs [mm], whatever the frame."""
    pairs = MIDDLE + rng.uniform(-HALF_MM, HALF_MM, (200, 2, 3))
    read = noisy(rig(), pairs, rng).reshape(-1, 4)
    batch = reconstruct(found.calibration.models, read, np.full(4, SIGMA_PX))
    seen = batch.position_mm.reshape(-1, 2, 3)
    error = np.linalg.norm(seen[:, 0] - seen[:, 1], axis=1) - np.linalg.norm(
        pairs[:, 0] - pairs[:, 1], axis=1
    )
    return float(np.sqrt((error**2).mean()))
