"""Sensor configurations of case marker-capacity: cameras, noise, volumes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.measurement.measurement_model import MeasurementModel
from compute.optics.profiles.profile_loader import load_profile
from compute.planning.coverage import Box, volume_grid
from compute.planning.planning_device import planning_device
from compute.planning.simulated_readings import simulate_readings
from compute.reconstruction.solver import PointSolver

Array = NDArray[np.float64]

PER_SIDE: Final = 3
"""Points of the volume along each side, for the cameras and their noise."""
HALF_BAR_MM: Final = 300.0


@dataclass(frozen=True, eq=False)
class Rig:
    """One configuration.

    Args:
        name: in tables.
        cameras: S perspective cameras.
        pixels: of a line.
        sigma_px: median over the volume of the Cramer-Rao bound with the pixels' pattern on top,
            shape (S,).
        box: where the markers are.
        solver: of these cameras.
    """

    name: str
    cameras: CameraStack
    pixels: int
    sigma_px: Array
    box: Box
    solver: PointSolver

    @property
    def sensors(self) -> int:
        """Number of sensors."""
        return len(self.cameras)

    @property
    def model(self) -> MeasurementModel:
        """The measurement model of the cameras."""
        return MeasurementModel(self.cameras, pixels=(self.pixels,) * self.sensors)


@cache
def profile_rig(name: str) -> Rig:
    """Return the rig of a profile: cameras calibrated on exact readings of its volume."""
    profile = load_profile(name)
    device = planning_device(profile)
    box = Box(profile.volume.centre_mm, profile.volume.size_mm)
    positions = volume_grid(box, (PER_SIDE, PER_SIDE, PER_SIDE))
    found = simulate_readings(device, positions.points_mm, lambda _: None)
    sigma = np.nanmedian(np.hypot(found.bound_px, found.pattern_px), axis=0)
    solver = PointSolver(found.cameras, device="cpu", threads=1)
    return Rig(name, found.cameras, device.pixels, sigma, box, solver)


@cache
def bar_of(sensors: int) -> Rig:
    """Return a bar as long as the profile ``bar``, with more sensors of its kind.

    They stand evenly along it, in two rows as there, and their lines turn by equal angles.
    """
    bar = profile_rig("bar")
    target = np.asarray(bar.box.centre_mm)
    height = 86.0 * (-1.0) ** (np.arange(sensors) // 2)
    positions = np.column_stack(
        [np.linspace(-HALF_BAR_MM, HALF_BAR_MM, sensors), height, np.zeros(sensors)]
    )
    # Neighbours measure across each other, as far as the number of sensors lets them.
    turns = (np.arange(sensors) * (sensors // 2 - 1)) % sensors * np.pi / sensors
    focus = float(np.abs(bar.cameras.principal_distance_px).mean())
    models = []
    for index, (place, turn) in enumerate(zip(positions, turns, strict=True)):
        view = (target - place) / np.linalg.norm(target - place)
        side = np.cross([0.0, 1.0, 0.0], view)
        side /= np.linalg.norm(side)
        along = np.cos(turn) * side + np.sin(turn) * np.cross(view, side)
        rotation = np.array([along, np.cross(view, along), view])
        x, y, z = Rotation.from_matrix(rotation).as_rotvec().tolist()
        offset = -rotation @ place
        model = SensorModel(
            f"s{index + 1}", bar.pixels, focus, 0.5 * (bar.pixels - 1), (x, y, z),
            float(offset[0]), float(offset[2]),
        )  # fmt: skip
        models.append(model)
    cameras = CameraStack.of(models)
    sigma = np.full(sensors, float(bar.sigma_px.mean()))
    solver = PointSolver(cameras, device="cpu", threads=1)
    return Rig(f"bar, {sensors} sensors", cameras, bar.pixels, sigma, bar.box, solver)


def with_noise(rig: Rig, sigma_px: float) -> Rig:
    """Return a rig whose readings are less certain by so much."""
    return replace(rig, sigma_px=np.hypot(rig.sigma_px, sigma_px))


RIGS: Final[tuple[Callable[[], Rig], ...]] = (
    partial(profile_rig, "dainis-1990-three"),
    partial(profile_rig, "dainis-1990-four"),
    partial(profile_rig, "thesis-5.1"),
    partial(profile_rig, "thesis-5.2"),
    partial(profile_rig, "thesis-5.9"),
    partial(profile_rig, "optotrak"),
    partial(profile_rig, "bar"),
    partial(bar_of, 8),
)
