"""TrackerSettings: motion, detection, initiation and termination parameters."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Literal, get_args

from compute.errors import InvalidParameter

MotionModel = Literal["velocity", "acceleration", "interacting"]
"""Constant velocity, constant acceleration, or both interacting."""


_RANGES: tuple[tuple[tuple[str, ...], Callable[[float], bool], str], ...] = (
    (
        (
            "acceleration_psd",
            "jerk_psd",
            "mean_sojourn_s",
            "start_speed_mm_s",
            "start_acceleration_mm_s2",
            "clutter_density_per_px",
            "resolution_px",
            "max_prediction_sigma_px",
            "coast_s",
        ),
        lambda value: 0.0 < value < inf,
        "be finite and above 0",
    ),
    (
        ("detection_probability", "false_track_probability"),
        lambda value: 0.0 < value < 1.0,
        "lie between 0 and 1",
    ),
    (("gate_sigma",), lambda value: 1.0 < value < inf, "be finite and above 1"),
    (("confirm_hits", "max_hypotheses"), lambda value: 1 <= value < inf, "be 1 or more"),
    (("initiation_interval_s", "confirm_misses"), lambda value: 0 <= value < inf, "be 0 or more"),
)
"""Names of values, whether a value is allowed, and what it must be."""


@dataclass(frozen=True)
class TrackerSettings:
    """Parameters of the tracker; the defaults suit hand-held markers at 100 Hz and more.

    Args:
        motion: the motion model.
        acceleration_psd: spectral density of the constant-velocity model's acceleration
            [mm^2/s^3]: after t seconds the velocity is uncertain by sqrt(this t).
        jerk_psd: spectral density of the constant-acceleration model's jerk [mm^2/s^5].
        mean_sojourn_s: mean time that a marker keeps to one of two interacting models [s].
        start_speed_mm_s: standard deviation of a new track's velocity along each axis [mm/s].
        start_acceleration_mm_s2: likewise of its acceleration [mm/s^2].
        detection_probability: probability that a sensor has a peak of a marker that lies in its
            view.
        clutter_density_per_px: expected number of false peaks per pixel and exposure.
        resolution_px: distance of two peaks at which every second pair is found as one peak [px].
        gate_sigma: readings further than this from their prediction are not a track's.
        max_prediction_sigma_px: where a sensor's reading is predicted less well than this (standard
            deviation), a track takes no peak of it; where one is four times as bad, it takes no
            single peaks at all, but points of three sensors or more [px].
        confirm_hits: exposures that must have seen a track, after its first, before it is a marker.
        confirm_misses: exposures that may miss it until then; with one more it ends. The second one
            must see it.
        false_track_probability: accepted probability that a track of false peaks is confirmed.
        coast_s: how long a confirmed track is predicted without being seen, then it ends [s].
        initiation_interval_s: least time between two searches for new markers in peaks that are
            left over, while none has just begun [s]. A strobed marker without a track is sought at
            once.
        max_hypotheses: joint hypotheses of one cluster and sensor that are kept.

    Raises:
        InvalidParameter: a value outside its range.
    """

    motion: MotionModel = "interacting"
    acceleration_psd: float = 1e4
    jerk_psd: float = 1e8
    mean_sojourn_s: float = 0.3
    start_speed_mm_s: float = 500.0
    start_acceleration_mm_s2: float = 3000.0
    detection_probability: float = 0.95
    clutter_density_per_px: float = 2e-4
    resolution_px: float = 4.0
    gate_sigma: float = 4.5
    max_prediction_sigma_px: float = 10.0
    confirm_hits: int = 3
    confirm_misses: int = 2
    false_track_probability: float = 1e-6
    coast_s: float = 1.0
    initiation_interval_s: float = 0.05
    max_hypotheses: int = 256

    def __post_init__(self) -> None:
        if self.motion not in get_args(MotionModel):
            raise InvalidParameter(
                f"motion is {self.motion!r}; it must be one of {', '.join(get_args(MotionModel))}"
            )
        for names, allowed, message in _RANGES:
            for name in names:
                value = getattr(self, name)
                if not allowed(value):
                    raise InvalidParameter(f"{name} is {value}; it must {message}")
