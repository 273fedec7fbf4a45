"""A hall with two bars of four sensors, a tool on a circle, and the bars' clocks."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.optics.sensor_placement import place_sensor
from compute.pose.rigid_body import RigidBody
from compute.transform import rotation_matrix

Array = NDArray[np.float64]

CENTRE_MM: Final = np.array([0.0, 0.0, 2500.0])
BARS: Final = (
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ((2500.0, 0.0, 2500.0), (0.0, 0.0, 1.0)),
)
"""Middle of each bar, and its direction: one looks along Z, the other along -X."""
ALONG_MM: Final = (-300.0, -100.0, 100.0, 300.0)
SIGMA_PX: Final = 0.05
RATE_HZ: Final = 500.0
OFFSET_S: Final = 200e-6
SKEW: Final = 1e-4
"""Of the second bar's clock against the first one's."""
RADIUS_MM: Final = 300.0
TURNING_RAD_S: Final = np.array([0.5, -1.0, 0.7])
"""Of a tool that moves."""
MARKERS_MM: Final = np.array(
    [[0.0, 0.0, 0.0], [60.0, 0.0, 5.0], [20.0, 50.0, 0.0], [-30.0, 30.0, 25.0]]
)
TOOL: Final = RigidBody("pointer", MARKERS_MM, (0, 1, 2, 3), (0.0, 0.0, -150.0))
CONTROL_POINTS: Final = 80
CONTROL_MM: Final = 450.0


def hall() -> tuple[SensorModel, ...]:
    """Return the true cameras, bar by bar."""
    models: list[SensorModel] = []
    for number, (middle, along) in enumerate(BARS):
        view = CENTRE_MM - np.array(middle)
        view /= np.linalg.norm(view)
        side = np.cross([0.0, 1.0, 0.0], view)
        for place, angle in zip(ALONG_MM, np.pi / 2 + np.pi / 4 * np.arange(4), strict=True):
            direction = np.cos(angle) * side + np.sin(angle) * np.array([0.0, 1.0, 0.0])
            x, y, z = np.array(middle) + place * np.array(along)
            models.append(
                place_sensor(
                    f"bar{number + 1}.s{len(models) % 4 + 1}",
                    lens_position_mm=(float(x), float(y), float(z)),
                    aim_mm=(0.0, 0.0, 2500.0),
                    measured_direction=(float(direction[0]), float(direction[1]),
                                        float(direction[2])),
                    principal_distance_mm=36.0,
                    pixels=2048,
                    pitch_um=12.0,
                ).model
            )  # fmt: skip
    return tuple(models)


def joint_calibration(true: CameraStack, rng: np.random.Generator) -> Calibration:
    """Calibrate all eight sensors from control points at rest that both bars see."""
    points = CENTRE_MM + rng.uniform(-CONTROL_MM, CONTROL_MM, (CONTROL_POINTS, 3))
    readings = true.project(points)
    # Each is the mean of a hundred exposures.
    sigma = np.full(readings.shape, 0.1 * SIGMA_PX)
    readings += sigma * rng.standard_normal(readings.shape)
    geometry = [SensorGeometry(model.name, model.pixels) for model in hall()]
    return calibrate(points, readings, geometry, sigma)


def tool_pose(time_s: Array, speed_mm_s: float) -> tuple[Array, Array]:
    """Return rotations (N, 3, 3) and origins (N, 3) [mm] of the tool on its circle."""
    angle = speed_mm_s / RADIUS_MM * time_s
    turning = TURNING_RAD_S * min(1.0, speed_mm_s)
    rotation = rotation_matrix(turning * time_s[:, None]) @ rotation_matrix(np.array([0.3, 0.2, 0]))
    circle = np.stack([np.cos(angle), 0.4 * np.sin(angle), 0.9 * np.sin(angle)], axis=1)
    return rotation, CENTRE_MM + RADIUS_MM * circle


def lit_markers(time_s: Array, slot: NDArray[np.intp], speed_mm_s: float) -> Array:
    """Return where the lit marker is, shape (N, 3) [mm]."""
    rotation, origin = tool_pose(time_s, speed_mm_s)
    positions: Array = np.einsum("nij,nj->ni", rotation, MARKERS_MM[slot]) + origin
    return positions


@dataclass(frozen=True, eq=False)
class HallRun:
    """N exposures of both bars, of a tool whose markers are lit one after the other.

    Args:
        time_s: of the first bar's exposures, whose clock is the reference, shape (N,) [s].
        slot: the marker that is lit, shape (N,).
        marker_mm: where it is then, shape (N, 3).
        first_px: readings of the first bar, shape (N, 4).
        second_time_s: of the second bar's exposures, as its corrected clock states them, (N,) [s].
        second_px: its readings, shape (N, 4).
        together_px: all eight sensors, exposed with the first bar, with the same noise, shape
            (N, 8).
    """

    time_s: Array
    slot: NDArray[np.intp]
    marker_mm: Array
    first_px: Array
    second_time_s: Array
    second_px: Array
    together_px: Array


def draw_run(
    true: CameraStack,
    speed_mm_s: float,
    seconds: float,
    clock_error_s: float,
    rng: np.random.Generator,
) -> HallRun:
    """Draw the phase of both bars, and noise.

    Args:
        true: the cameras.
        speed_mm_s: of the tool.
        seconds: how long.
        clock_error_s: what is left of the second bar's clock after it was corrected.
        rng: of all that is drawn.
    """
    count = round(seconds * RATE_HZ)
    slot = np.arange(count) % len(MARKERS_MM)
    time_s = np.arange(count) / RATE_HZ
    shown_s = time_s + rng.uniform(-0.5, 0.5) / RATE_HZ
    # Exposed when its own clock, 200 us and 100 ppm off, shows these times.
    second_s = (shown_s - OFFSET_S) / (1.0 + SKEW)
    marker = lit_markers(time_s, slot, speed_mm_s)
    then = lit_markers(second_s, slot, speed_mm_s)

    # The same noise in both, so that their difference is not that of noise.
    noise = SIGMA_PX * rng.standard_normal((count, len(true)))
    together = true.project(marker) + noise
    return HallRun(
        time_s,
        slot,
        marker,
        together[:, :4],
        second_s + clock_error_s,
        true.project(then)[:, 4:] + noise[:, 4:],
        together,
    )
