"""Settings of the thesis's trackers."""

from dataclasses import dataclass
from math import isfinite
from typing import Final, Literal, get_args

from compute.errors import InvalidParameter
from validation.thesis_tracking.intervals import Velocity
from validation.thesis_tracking.pair_tracker import Decision
from validation.thesis_tracking.quadratic_window import THESIS_POINTS, QuadraticWindow
from validation.thesis_tracking.track_swap import SWAP_THRESHOLD

ThesisMethod = Literal["window", "probabilistic", "eight-state"]
"""Section 6.1.3, section 6.2.2, or [6.11]."""

LIMIT_SHARE: Final = 0.5
"""The velocity limit where none is given, as a share of the greatest velocity."""
MIN_SENSORS: Final = 3
"""Whose tracks make a point."""
MAX_TARGETS: Final = 2
"""That section 6.1.3 tells apart along a sensor."""


@dataclass(frozen=True)
class ThesisSettings:
    """A method of chapter 6 of the thesis and its parameters.

    The text has hardly a number; what stands here in its place is for hand-held markers before
    sensors of 2048 pixels. Velocities along the sensors are what counts: look at them first.

    Args:
        method: which one.
        markers: "window": how many are lit together, 1 or 2. Strobed ones are followed each by
            itself, any number of them.
        window_points: "window": n of section 6.1.3, 3 or more.
        window_decision: "window": how a track is taken through a crossing; ``PairTracking``.
        velocity_limit_px_s: "window": delta of section 6.1.3; None: half of
            ``max_velocity_px_s``. A crossing changes the velocity by up to twice the targets'.
        max_velocity_px_s: "window" and "probabilistic": v_max of section 6.2.2. What lies
            further from a track's last point than it allows is not the track's.
        interval_velocity: "probabilistic": a target's velocity; ``velocity_estimate``.
        min_interval_px: "probabilistic": least half width of the interval of [6.7].
        swap_threshold: "probabilistic": of [6.9], between 0 and 1.
        acceleration_psd: spectral density of the acceleration of [6.1], [6.2] in space, and of
            that along Z in [6.11] [mm^2/s^3].
        jerk_psd: spectral density of the jerk along X and Y in [6.11] [mm^2/s^5].
        young_scans: scans that must have seen a track before it counts: "three successive scans".
        coast_scans: scans in a row that a track along a sensor outlives without a point.
        coast_s: how long a marker is predicted without being seen, then it ends [s].
        gate_sigma: readings further than this from a marker's prediction in space are not its.

    Raises:
        InvalidParameter: a value outside its range.
    """

    method: ThesisMethod = "window"
    markers: int = MAX_TARGETS
    window_points: int = THESIS_POINTS
    window_decision: Decision = "velocity"
    velocity_limit_px_s: float | None = None
    max_velocity_px_s: float = 2000.0
    interval_velocity: Velocity = "mean"
    min_interval_px: float = 1.0
    swap_threshold: float = SWAP_THRESHOLD
    acceleration_psd: float = 1e4
    jerk_psd: float = 1e8
    young_scans: int = 3
    coast_scans: int = 6
    coast_s: float = 1.0
    gate_sigma: float = 4.5

    def __post_init__(self) -> None:
        for name, choices in (
            ("method", get_args(ThesisMethod)),
            ("window_decision", get_args(Decision)),
            ("interval_velocity", get_args(Velocity)),
        ):
            value = getattr(self, name)
            if value not in choices:
                raise InvalidParameter(
                    f"{name} is {value!r}; it must be one of {', '.join(choices)}", **{name: value}
                )
        if self.markers not in range(1, MAX_TARGETS + 1):
            raise InvalidParameter(
                f"markers is {self.markers}; section 6.1.3 tells at most {MAX_TARGETS} targets "
                "along a sensor apart: it must be 1 or 2, or take probabilistic or eight-state",
                markers=self.markers,
            )
        QuadraticWindow(self.window_points)
        for name in ("max_velocity_px_s", "min_interval_px", "acceleration_psd", "jerk_psd",
                     "coast_s", "velocity_limit_px_s"):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value > 0.0):
                raise InvalidParameter(
                    f"{name} is {value}; it must be above zero and finite", **{name: value}
                )
        if not 0.0 < self.swap_threshold < 1.0:
            raise InvalidParameter(
                f"swap_threshold is {self.swap_threshold}; it must lie between 0 and 1"
            )
        if not (isfinite(self.gate_sigma) and self.gate_sigma > 1.0):
            raise InvalidParameter(
                f"gate_sigma is {self.gate_sigma}; it must be finite and above 1"
            )
        for name, least in (("young_scans", 1), ("coast_scans", 0)):
            if getattr(self, name) < least:
                raise InvalidParameter(
                    f"{name} is {getattr(self, name)}; it must be {least} or more"
                )

    @property
    def limit_px_s(self) -> float:
        """The velocity limit delta [px/s]."""
        if self.velocity_limit_px_s is not None:
            return self.velocity_limit_px_s
        return LIMIT_SHARE * self.max_velocity_px_s
