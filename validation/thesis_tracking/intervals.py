"""Prediction intervals of a target in the next scan, [6.7] and [6.8], section 6.2.2."""

from dataclasses import dataclass
from math import isfinite
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from validation.thesis_tracking.quadratic_window import QuadraticWindow

Array = NDArray[np.float64]

Form = Literal["ahead", "about"]
"""Which interval; ``position_interval`` says what each is."""

Velocity = Literal["mean", "curve"]
"""What a target's velocity is; ``velocity_estimate`` says what each is."""


_TELLING: Final = 3


@dataclass(frozen=True)
class PositionInterval:
    """Where a target may be in the next scan.

    Args:
        centre_px: its middle.
        half_width_px: half its width, above zero.
    """

    centre_px: float
    half_width_px: float

    def __contains__(self, position_px: float) -> bool:
        """Say whether a position lies in it."""
        return abs(position_px - self.centre_px) <= self.half_width_px


@dataclass(frozen=True)
class VelocityEstimate:
    """The mean velocity of a target over its last scans, and how it varies.

    Args:
        mean_px_s: v_j, or what goes for it.
        deviation_px_s: sigma_vj.
    """

    mean_px_s: float
    deviation_px_s: float


@dataclass(frozen=True)
class IntervalSettings:
    """How intervals are made.

    Args:
        max_velocity_px_s: v_max: a target's velocity lies within ``[-v_max, v_max]``; without a
            velocity yet, in its first scan, a target may be anywhere within.
        scans: velocities between so many successive scans at most are averaged. The text says
            "taken between each two scans", and not of how many; here as many as the window of
            section 6.1.3 has.
        form: which interval.
        velocity: what a target's velocity is.
        min_half_width_px: an interval is not narrower: the text has no noise of the readings,
            and a still target's deviation of velocity would leave it no room.

    Raises:
        InvalidParameter: a value outside its range.
    """

    max_velocity_px_s: float
    scans: int = 6
    form: Form = "ahead"
    velocity: Velocity = "mean"
    min_half_width_px: float = 1.0

    def __post_init__(self) -> None:
        for name in ("max_velocity_px_s", "min_half_width_px"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0.0):
                raise InvalidParameter(
                    f"{name} is {value}; it must be above zero and finite", **{name: value}
                )
        if self.scans < 1:
            raise InvalidParameter(f"scans is {self.scans}; it must be 1 or more", scans=self.scans)
        for name, choices in (("form", get_args(Form)), ("velocity", get_args(Velocity))):
            value = getattr(self, name)
            if value not in choices:
                raise InvalidParameter(
                    f"{name} is {value!r}; it must be one of {choices}", **{name: value}
                )


def velocity_estimate(
    position_px: Array, interval_s: float, settings: IntervalSettings
) -> VelocityEstimate:
    """Return velocity and standard deviation of the velocities between the last scans.

    - "mean": the mean of these velocities, as section 6.2.2 has it. A target that accelerates
      evenly by a is (n + 1)/2 a ahead of the mean of n, and two deviations are hardly more
      (n = 6: 3.5 and 3.7): any noise puts it outside.
    - "curve": the velocity in which the quadratic window of as many scans goes on; section 2.5
      has the dynamic model "update the information of the tracks" by that curve.

    Fewer than three velocities tell no deviation, and none no mean: then v_max stands in, half of
    it for a deviation, of which two are taken. (The deviation of two velocities of a target that
    accelerates evenly leaves the third outside its interval, always.)

    Args:
        position_px: of successive scans, shape (N,), N >= 1 [px].
        interval_s: the sampling period [s].
        settings: of the intervals.
    """
    most = settings.max_velocity_px_s
    last = position_px[-settings.scans - 1 :]
    velocity = np.diff(last) / interval_s
    if not len(velocity):
        return VelocityEstimate(0.0, most / 2.0)
    mean = float(velocity.mean())
    if settings.velocity == "curve" and len(velocity) >= _TELLING:
        ahead = QuadraticWindow(len(last)).fit(last).next_position
        mean = (ahead - float(last[-1])) / interval_s
    deviation = float(velocity.std(ddof=1)) if len(velocity) >= _TELLING else most / 2.0
    return VelocityEstimate(min(max(mean, -most), most), min(deviation, most / 2.0))


def position_interval(
    position_px: float, velocity: VelocityEstimate, interval_s: float, settings: IntervalSettings
) -> PositionInterval:
    """Return the interval of a target's next position.

    - "ahead": [6.7], two deviations of the velocity about the position that the dynamic model
      [6.2] predicts: ``X + v dT +- 2 sigma dT``.
    - "about": [6.8] as printed, ``X +- (v dT + 2 sigma dT)``, about the present position, with
      the magnitude of v, as a target that moves to the left would have a negative width. It
      holds the first, and where the target has come from besides.

    Args:
        position_px: X_j, the last position.
        velocity: of the target.
        interval_s: time since [s]: the sampling period, if the target was seen in the last scan.
        settings: of the intervals.
    """
    spread = 2.0 * velocity.deviation_px_s * interval_s
    if settings.form == "ahead":
        ahead = position_px + velocity.mean_px_s * interval_s
        return PositionInterval(ahead, max(spread, settings.min_half_width_px))
    reach = abs(velocity.mean_px_s) * interval_s + spread
    return PositionInterval(position_px, max(reach, settings.min_half_width_px))
