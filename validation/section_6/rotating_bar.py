"""The rotating bar of chapter 6: markers, cameras and readings."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from validation.table_5.calibration_frame import frame, metric_models

Array = NDArray[np.float64]

BAR_MM: Final = 292.0
"""Section 6.1.2: "separated by a distance of 292 mm"."""
TURN_S: Final = 2.0
"""Section 6.1.2: "one full turn completed in 2 seconds"."""
RATE_HZ: Final = 30.0
"""Section 6.1.2: "about 30 frames/second"."""
FRAMES: Final = 350
STILL_FRAMES: Final = 25
"""At either end: 350 frames hold 10 s of turning, 300 frames, and "a short interval" of rest."""
RAMP_S: Final = 0.4
"""In which the motor starts, and stops; assumed: the text says that it varied there."""
TURNING: Final = slice(
    STILL_FRAMES + int(RAMP_S * RATE_HZ) + 1, FRAMES - STILL_FRAMES - int(RAMP_S * RATE_HZ) - 1
)
"""The frames in which the bar turns evenly: those that figures are taken from. At rest, sensor 1
sees both markers one behind the other."""
PASSIVE_FRAMES: Final = 250
PASSIVE_RADII_MM: Final = (-95.0, 0.0, 146.0)
"""Section 6.2.1: one at the centre, "the other two on the sides at different distances"."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Markers on the bar.

    Args:
        time_s: of the exposures, shape (N,).
        position_mm: shape (N, M, 3).
        velocity_mm_s: shape (N, M, 3).
        acceleration_mm_s2: shape (N, M, 3).
    """

    time_s: Array
    position_mm: Array
    velocity_mm_s: Array
    acceleration_mm_s2: Array


@dataclass(frozen=True, eq=False)
class Readings:
    """What the sensors would read, and how it changes.

    Args:
        position_px: shape (N, M, S).
        velocity_px_s: shape (N, M, S).
        acceleration_px_s2: shape (N, M, S).
    """

    position_px: Array
    velocity_px_s: Array
    acceleration_px_s2: Array


@cache
def cameras() -> tuple[SensorModel, ...]:
    """Return the four cameras of Figure 5.9 as calibrated from the measured frame at 1 m.

    Not those of Table 5.10, whose principal distance of 50 mm puts the bar outside the sensors.
    """
    return metric_models()


@cache
def centre_mm() -> Array:
    """Return the middle of the calibration frame at 1 m, where the bar turns; assumed."""
    points = frame().points_mm
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2.0)


def two_active(time_s: Array) -> Motion:
    """Return both markers at the ends of the bar at times (N,) since the first frame.

    The bar rests along X, turns counter-clockwise in the plane of X and Y (Figure 6.13), five
    times in all, and rests again.
    """
    first = STILL_FRAMES / RATE_HZ
    turning = FRAMES / RATE_HZ - 2.0 * first
    radii = np.array([BAR_MM / 2.0, -BAR_MM / 2.0])
    return _turned(radii, time_s, _ramped(time_s - first, turning))


def three_passive(time_s: Array) -> Motion:
    """Return three markers on the bar, which turns all the time, at times (N,)."""
    speed = 2.0 * np.pi / TURN_S
    angle = np.stack([speed * time_s + 0.3, np.full_like(time_s, speed), np.zeros_like(time_s)])
    return _turned(np.array(PASSIVE_RADII_MM), time_s, angle)


def readings(motion: Motion, models: tuple[SensorModel, ...]) -> Readings:
    """Return what cameras would read of markers, without noise.

    Velocity and acceleration by differences over a hundredth of a frame: exact to the digits
    that are shown.
    """
    stack = CameraStack.of(list(models))
    step = 0.01 / RATE_HZ

    def at(t: float) -> Array:
        position = (
            motion.position_mm + motion.velocity_mm_s * t + motion.acceleration_mm_s2 * t * t / 2.0
        )
        return stack.project(position.reshape(-1, 3)).reshape(*position.shape[:2], len(models))

    before, now, after = at(-step), at(0.0), at(step)
    return Readings(now, (after - before) / (2.0 * step), (after - 2.0 * now + before) / step**2)


def _ramped(time_s: Array, turning_s: float) -> Array:
    """Return angle, speed and angular acceleration, shape (3, N): even, with ramps at the ends."""
    # A ramp covers half of what full speed would: as long as the turns are whole, the speed
    # between is a little higher than a turn in 2 s.
    speed = 2.0 * np.pi / TURN_S * turning_s / (turning_s - RAMP_S)
    up = np.clip(time_s, 0.0, RAMP_S)
    even = np.clip(time_s - RAMP_S, 0.0, turning_s - 2.0 * RAMP_S)
    down = np.clip(time_s - (turning_s - RAMP_S), 0.0, RAMP_S)
    angle = speed * (up**2 / (2.0 * RAMP_S) + even + down - down**2 / (2.0 * RAMP_S))
    going = (time_s > 0.0) & (time_s < turning_s)
    return np.stack(
        [
            angle,
            np.where(going, speed * (up - down) / RAMP_S, 0.0),
            np.where(going, speed / RAMP_S * ((time_s < RAMP_S) * 1.0 - (down > 0.0)), 0.0),
        ]
    )


def _turned(radius_mm: Array, time_s: Array, angle: Array) -> Motion:
    turned, speed, faster = angle[:, :, None]
    outwards = np.stack([np.cos(turned), np.sin(turned), np.zeros_like(turned)], axis=-1)
    across = np.stack([-np.sin(turned), np.cos(turned), np.zeros_like(turned)], axis=-1)
    radius = radius_mm[:, None]
    speed, faster = speed[..., None], faster[..., None]
    return Motion(
        time_s,
        centre_mm() + radius * outwards,
        radius * speed * across,
        radius * (faster * across - speed**2 * outwards),
    )
