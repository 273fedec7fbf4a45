"""Tracking settings of a device: markers, tools and blink codes, as clients send them."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from compute.pose.settings import MotionSettings, ToolTrackerSettings
from compute.tracking.blink_codes import MAX_CODE_LENGTH, BlinkCodes
from compute.tracking.blink_decoding import BlinkModel
from compute.tracking.factory import TrackingSettings
from compute.tracking.settings import MotionModel, TrackerSettings
from compute.tracking.thesis.intervals import Velocity
from compute.tracking.thesis.pair_tracker import Decision
from compute.tracking.thesis.settings import MAX_TARGETS, ThesisMethod, ThesisSettings
from service.api.base_models import Position, RequestModel

_TRACKER = TrackerSettings()
_TOOLS = ToolTrackerSettings()
_THESIS = ThesisSettings()

Velocity1D = Annotated[float, Field(ge=1e-3, le=1e9)]


MAX_CODE_WORDS = 64
MIN_BITS = 5
MIN_DISTANCE = 3
"""So that one wrong scan of a word is corrected, and two do not make it another."""


class Blinking(RequestModel):
    """The codes that markers show, one bit an exposure, again and again."""

    words: Annotated[
        list[
            Annotated[
                str, Field(min_length=MIN_BITS, max_length=MAX_CODE_LENGTH, pattern="^[01]*$")
            ]
        ],
        Field(min_length=1, max_length=MAX_CODE_WORDS),
    ] = Field(
        description="Of marker 0, 1, ..., all equally long: 1 for full light, 0 for little. Any "
        f"two must differ in {MIN_DISTANCE} bits at least, in whatever phase; "
        "`lumiline blink-codes` makes such words.",
        examples=[["000000010111", "000000111011"]],
    )
    off_level: Annotated[float, Field(ge=0.05, le=0.8)] = Field(
        default=0.4,
        description="Light of a 0, relative to a 1. Markers must not go dark: what is not "
        "seen in half of the exposures is not tracked well.",
    )
    miss_probability: Annotated[float, Field(ge=1e-4, le=0.5)] = Field(
        default=BlinkModel().miss_probability,
        description="Chance that a sensor misses a marker's peak.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.codes()
        return self

    def codes(self) -> tuple[BlinkCodes, BlinkModel]:
        """Return the codes, and how the markers show them.

        Raises:
            InvalidParameter: words of several lengths, or too near to each other.
        """
        codes = BlinkCodes(tuple(self.words), MIN_DISTANCE)
        return codes, BlinkModel(miss_probability=self.miss_probability, off_level=self.off_level)


class Tracking(RequestModel):
    """How the markers and tools of a running device are tracked; all has defaults."""

    tracks: Literal["never", "with-tools", "always"] = Field(
        default="never",
        description="Whether markers are followed as tracks: never, as soon as the device has "
        "tools, or always. Tools are tracked in any case; tracks beside them cost time.",
    )
    method: Literal["readings"] | ThesisMethod = Field(
        default="readings",
        description="How markers are followed: by filtering on the sensors' readings, which is "
        "the best; or, for comparison, by a method of Georgiev's thesis: the dynamic model with "
        "a quadratic window and the velocity-change test (section 6.1.3), probabilistic "
        "association ([6.6] to [6.10]), or the 8-state model in space ([6.11]). Tools are not "
        "concerned.",
    )
    motion: MotionModel = Field(
        default=_TRACKER.motion,
        description="How markers move: at constant velocity, at constant acceleration, or "
        "whichever of the two fits. Of `readings`.",
    )
    window_markers: Annotated[int, Field(ge=1, le=MAX_TARGETS)] = Field(
        default=_THESIS.markers,
        description="Markers that are lit together, 1 or 2: more the method does not tell apart. "
        "Any number of them may be strobed. Of `window`.",
    )
    window_points: Annotated[int, Field(ge=3, le=50)] = Field(
        default=_THESIS.window_points, description="Points of the quadratic window. Of `window`."
    )
    window_decision: Decision = Field(
        default=_THESIS.window_decision,
        description="How a track is taken through a crossing: by the change of velocity, as "
        "the thesis has it, or to the point nearer to the window's prediction. Of `window`.",
    )
    velocity_limit_px_s: Velocity1D | None = Field(
        default=_THESIS.velocity_limit_px_s,
        description="Change of velocity along a sensor above which two markers have crossed "
        "[px/s]; null: half of `max_velocity_px_s`. Of `window`.",
    )
    max_velocity_px_s: Velocity1D = Field(
        default=_THESIS.max_velocity_px_s,
        description="Greatest velocity of a marker along a sensor [px/s]. Of `window` and "
        "`probabilistic`.",
    )
    interval_velocity: Velocity = Field(
        default=_THESIS.interval_velocity,
        description="Velocity with which the interval of [6.7] moves on: the mean of the last "
        "ones, as the thesis has it, or that of a curve through them. Of `probabilistic`.",
    )
    min_interval_px: Annotated[float, Field(ge=1e-3, le=1e4)] = Field(
        default=_THESIS.min_interval_px,
        description="Least half width of that interval [px]. Of `probabilistic`.",
    )
    swap_threshold: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=_THESIS.swap_threshold,
        description="Probability [6.9] at which two markers are on one track. Of `probabilistic`.",
    )
    acceleration_psd: Annotated[float, Field(ge=1e-3, le=1e12)] = Field(
        default=_TRACKER.acceleration_psd,
        description="Spectral density of the acceleration at constant velocity [mm^2/s^3].",
    )
    jerk_psd: Annotated[float, Field(ge=1e-3, le=1e18)] = Field(
        default=_TRACKER.jerk_psd,
        description="Spectral density of the jerk at constant acceleration [mm^2/s^5].",
    )
    coast_s: Annotated[float, Field(ge=1e-3, le=60.0)] = Field(
        default=_TRACKER.coast_s,
        description="How long a track is predicted without being seen; then it ends.",
    )
    blinking: Blinking | None = Field(
        default=None,
        description="Codes by which the markers of tracks are named; null: they do not blink.",
    )
    tool_acceleration_mm_s2: Annotated[float, Field(ge=1e-3, le=1e7)] = Field(
        default=_TOOLS.motion.acceleration_mm_s2, description="RMS acceleration of tools."
    )
    tool_angular_acceleration_rad_s2: Annotated[float, Field(ge=1e-3, le=1e5)] = Field(
        default=_TOOLS.motion.angular_acceleration_rad_s2,
        description="RMS angular acceleration of tools.",
    )
    tool_coast_s: Annotated[float, Field(ge=1e-3, le=5.0)] = Field(
        default=_TOOLS.coast_s,
        description="Longest time that a pose rests on prediction alone; then it is MISSING.",
    )
    tool_tip_sd_mm: Annotated[float, Field(ge=1e-6, le=1e4)] = Field(
        default=_TOOLS.max_tip_sd_mm,
        description="Standard deviation of the tip in space above which a pose is HIGH_ERROR, of "
        "tools without a limit of their own.",
    )
    volume_mm: tuple[Position, Position] | None = Field(
        default=None,
        description="Lowest and highest corner of the volume that the calibration is good for; a "
        "pose outside is OUT_OF_VOLUME. null: only a correction table says.",
    )

    def tracker(self) -> TrackingSettings:
        """Return how markers are followed."""
        if self.method != "readings":
            return ThesisSettings(
                method=self.method,
                markers=self.window_markers,
                window_points=self.window_points,
                window_decision=self.window_decision,
                velocity_limit_px_s=self.velocity_limit_px_s,
                max_velocity_px_s=self.max_velocity_px_s,
                interval_velocity=self.interval_velocity,
                min_interval_px=self.min_interval_px,
                swap_threshold=self.swap_threshold,
                acceleration_psd=self.acceleration_psd,
                jerk_psd=self.jerk_psd,
                coast_s=self.coast_s,
            )
        return TrackerSettings(
            motion=self.motion,
            acceleration_psd=self.acceleration_psd,
            jerk_psd=self.jerk_psd,
            coast_s=self.coast_s,
        )

    def tool_tracker(self) -> ToolTrackerSettings:
        """Return how tools are followed.

        Raises:
            InvalidParameter: the volume's corners are not in order.
        """
        return ToolTrackerSettings(
            motion=MotionSettings(
                acceleration_mm_s2=self.tool_acceleration_mm_s2,
                angular_acceleration_rad_s2=self.tool_angular_acceleration_rad_s2,
            ),
            coast_s=self.tool_coast_s,
            max_tip_sd_mm=self.tool_tip_sd_mm,
            volume_mm=self.volume_mm,
        )
