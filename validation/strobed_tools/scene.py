"""Tools with strobed markers: their motion and their readings."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.pose.rigid_body import RigidBody
from compute.transform import rotation_matrix
from validation.partial_view.scene import CENTRE_MM, COVARIANCE, SIGMA_PX, TIP_MM

Array = NDArray[np.float64]
Course = Callable[[Array, np.random.Generator], tuple[Array, Array]]
"""Times (N,) [s] to how far a tool has gone [mm] and turned [rad], each (N,) or (N, 3)."""

MARKERS_MM: Final = np.array(
    [
        [0.0, 0.0, 0.0],
        [60.0, 0.0, 5.0],
        [20.0, 50.0, 0.0],
        [-30.0, 30.0, 25.0],
        [35.0, 30.0, 30.0],
        [-20.0, -25.0, 15.0],
    ]
)
"""A tool has the first few of them."""
REST, HELD, SLOW, FAST, STOPS = (
    "at rest",
    "held by hand",
    "slow, 50 mm/s",
    "fast, 500 mm/s",
    "stop and go",
)
BEAT_S: Final = 0.5
"""Between two jumps of the acceleration of what moves fast."""
TREMOR_HZ: Final = 9.0
STOPS_S: Final = 0.8
"""From one move to the next."""
MOVE_S: Final = 0.4
MOVE_MM: Final = 60.0


def _rest(time_s: Array, _: np.random.Generator) -> tuple[Array, Array]:
    return np.zeros_like(time_s), np.zeros_like(time_s)


def _held(time_s: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """A hand's tremor: 0.1 mm and 0.5 mrad RMS along each axis."""
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    hertz = TREMOR_HZ * rng.uniform(0.8, 1.2, (2, 3))
    wave = np.sqrt(2.0) * np.sin(2.0 * np.pi * hertz[:, None] * time_s[:, None] + phase[:, None])
    return 0.1 * wave[0], 5e-4 * wave[1]


def _slow(time_s: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """To and fro at up to 50 mm/s and 0.3 rad/s, every two seconds."""
    there = np.sin(np.pi * time_s + rng.uniform(0.0, 2.0 * np.pi)) / np.pi
    return 50.0 * there, 0.3 * there


def _fast(time_s: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """At up to 500 mm/s and 3 rad/s; 2 m/s^2 and 12 rad/s^2, which jump every half second."""
    beat = time_s / BEAT_S + float(rng.integers(2))
    part = beat % 1.0
    # The speed is a triangle between -1 and 1, the place its integral.
    there = np.where(beat % 2.0 < 1.0, 1.0, -1.0) * 0.5 * (part**2 - part)
    return 500.0 * there, 3.0 * there


def _stops(time_s: Array, _: np.random.Generator) -> tuple[Array, Array]:
    """Moves of 60 mm and 0.3 rad in 0.4 s with rests of 0.4 s: T. Flash and N. Hogan's reach.

    Least jerk (doi:10.1523/JNEUROSCI.05-07-01688.1985): up to 280 mm/s and 2.2 m/s^2.
    """
    beat = time_s / STOPS_S
    part = np.clip((beat % 1.0) * STOPS_S / MOVE_S - (STOPS_S - MOVE_S) / MOVE_S, 0.0, 1.0)
    there = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
    # Out and back.
    there = np.where(beat % 2.0 < 1.0, there, 1.0 - there)
    return MOVE_MM * there, 0.3 * there


COURSES: Final[dict[str, Course]] = {
    REST: _rest,
    HELD: _held,
    SLOW: _slow,
    FAST: _fast,
    STOPS: _stops,
}


def since_change_s(course: str, time_s: Array) -> Array | None:
    """Return the time since the motion last changed, shape (N,) [s]; None where it never does."""
    if course == FAST:
        return np.asarray(time_s % BEAT_S)
    if course == STOPS:
        # A move begins after each rest, a rest after each move.
        return np.asarray(time_s % (STOPS_S - MOVE_S))
    return None


@dataclass(frozen=True, eq=False)
class Run:
    """One tool before sensors whose calibration is a little off, over N exposures.

    Args:
        tool: its markers, strobed in turn.
        time_ns: of the exposures, shape (N,) [ns].
        marker: that is lit, shape (N,).
        rotation: R_world_tool, shape (N, 3, 3).
        translation_mm: of its origin, shape (N, 3) [mm].
        readings_px: of the lit marker, shape (N, S) [px].
    """

    tool: RigidBody
    time_ns: NDArray[np.int64]
    marker: NDArray[np.intp]
    rotation: Array
    translation_mm: Array
    readings_px: Array

    @property
    def tip_mm(self) -> Array:
        """The true tip, shape (N, 3) [mm]."""
        found: Array = self.rotation @ TIP_MM + self.translation_mm
        return found

    @property
    def bend_mm(self) -> float:
        """How far the tip leaves an even course from one exposure of a marker to the next, RMS."""
        tip, turn = self.tip_mm, len(self.tool)
        # Half of an acceleration times the time squared.
        off = 0.5 * (tip[2 * turn :] - 2.0 * tip[turn:-turn] + tip[: -2 * turn])
        return float(np.sqrt((off**2).sum(axis=1).mean()))


def pointer(markers: int) -> RigidBody:
    """Return a pointer of so many markers, its tip 150 mm from them."""
    return RigidBody(
        "pointer", MARKERS_MM[:markers], tuple(range(markers)), (TIP_MM[0], TIP_MM[1], TIP_MM[2])
    )


def draw_run(
    cameras: CameraStack,
    course: Course,
    markers: int,
    rate_hz: float,
    seconds: float,
    rng: np.random.Generator,
    sigma_px: float = SIGMA_PX,
) -> Run:
    """Draw a calibration's error, a tool's place and turn, the ways it goes and turns, and noise.

    Args:
        cameras: as they are calibrated; the true ones differ as COVARIANCE says.
        course: how it is moved.
        markers: of the tool.
        rate_hz: of exposures.
        seconds: how long.
        rng: of all that is drawn.
        sigma_px: deviation of the readings.
    """
    off = np.sqrt(np.diag(COVARIANCE)) * rng.standard_normal(len(COVARIANCE))
    true = cameras.retract(off.reshape(len(cameras), -1))
    tool = pointer(markers)
    count = round(seconds * rate_hz)
    time_s = np.arange(count) / rate_hz
    gone, turned = course(time_s, rng)
    way, axis = (one / np.linalg.norm(one) for one in rng.standard_normal((2, 3)))
    gone = gone[:, None] * way if gone.ndim == 1 else gone
    turned = turned[:, None] * axis if turned.ndim == 1 else turned
    rotation = rotation_matrix(turned) @ rotation_matrix(rng.uniform(-1.5, 1.5, 3))
    centroid = CENTRE_MM + rng.uniform(-60.0, 60.0, 3) + gone
    translation = centroid - rotation @ tool.markers_mm.mean(axis=0)
    lit = np.arange(count) % markers
    positions = np.einsum("nij,nj->ni", rotation, tool.markers_mm[lit]) + translation
    exact = true.project(positions)
    return Run(
        tool,
        np.round(1e9 * time_s).astype(np.int64),
        lit,
        rotation,
        translation,
        exact + sigma_px * rng.standard_normal(exact.shape),
    )
