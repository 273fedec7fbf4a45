"""Tracking settings of a device: markers, tools and blink codes, as clients send them."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from compute.pose.settings import MotionSettings, PoseFitSettings, ToolTrackerSettings
from compute.tracking.blink_codes import MAX_CODE_LENGTH, BlinkCodes
from compute.tracking.blink_decoding import BlinkModel
from compute.tracking.settings import MotionModel, TrackerSettings
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import Position, RequestModel

_TRACKER = TrackerSettings()
_TOOLS = ToolTrackerSettings()


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
        FIRST_ERROR_ONLY,
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
        description="Probability that a sensor misses a marker's peak.",
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
    """Settings of tracking markers and tools of a running device; all have defaults."""

    tracks: Literal["never", "with-tools", "always"] = Field(
        default="never",
        description="Whether markers are tracked: never, as soon as the device has "
        "tools, or always. Tools are tracked in any case; tracks beside them cost time.",
    )
    motion: MotionModel = Field(
        default=_TRACKER.motion,
        description="How markers move: at constant velocity, at constant acceleration, or "
        "whichever of the two fits.",
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
    tool_max_detectable_sigma: Annotated[float, Field(ge=4.0, le=1e6)] | None = Field(
        default=_TOOLS.fit.max_detectable_sigma,
        description="Error of a single reading, in its standard deviations, that must be found "
        "whichever reading it is; where a larger one could pass, a pose is LOW_RELIABILITY. "
        "null: no limit.",
    )
    volume_mm: tuple[Position, Position] | None = Field(
        default=None,
        description="Lowest and highest corner of the volume that the calibration is good for; a "
        "pose outside is OUT_OF_VOLUME. null: only a correction table says.",
    )

    def tracker(self) -> TrackerSettings:
        """Return the settings of the tracker of markers."""
        return TrackerSettings(
            motion=self.motion,
            acceleration_psd=self.acceleration_psd,
            jerk_psd=self.jerk_psd,
            coast_s=self.coast_s,
        )

    def tool_tracker(self) -> ToolTrackerSettings:
        """Return the settings of the tracker of tools.

        Raises:
            InvalidParameter: the volume's corners are not in order.
        """
        return ToolTrackerSettings(
            fit=PoseFitSettings(max_detectable_sigma=self.tool_max_detectable_sigma),
            motion=MotionSettings(
                acceleration_mm_s2=self.tool_acceleration_mm_s2,
                angular_acceleration_rad_s2=self.tool_angular_acceleration_rad_s2,
            ),
            coast_s=self.tool_coast_s,
            max_tip_sd_mm=self.tool_tip_sd_mm,
            volume_mm=self.volume_mm,
        )
