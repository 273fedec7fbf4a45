"""Radiometric calibrations and their captures as clients send and receive them."""

from typing import Annotated, Any, Final, Literal

from pydantic import Field, StringConstraints

from compute.signal.centroid_settings import MAX_PIXELS, MIN_PIXELS
from compute.signal.radiometric_calibration import MIN_CAPTURES, MIN_FLATS
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import (
    Moment,
    Name,
    Note,
    RequestModel,
    ResponseModel,
    Slug,
)
from service.api.captures.schema import Captured, CaptureSession, NewCaptureSession
from service.api.devices.schema import RECORDING_PATTERN
from service.api.radiometric_calibrations.capture_checks import Kind

MAX_FRAMES: Final = 4096
MAX_FLATS: Final = 32
MAX_SCANS: Final = 1024
FULL_SCALE: Final = 65535

Temperature = Annotated[float, Field(ge=-100.0, le=200.0, description="Of the sensors [°C].")]


class RadiometricCaptureSettings(RequestModel):
    """Settings of capturing dark and flat frames."""

    frames: int = Field(default=128, ge=MIN_CAPTURES, le=MAX_FRAMES, description="Of each capture.")
    levels: int = Field(
        default=6,
        ge=MIN_FLATS,
        le=MAX_FLATS,
        description="Flat captures, of different amounts of light.",
    )
    max_level: Annotated[float, Field(ge=0.2, le=0.95)] = Field(
        default=0.85, description="Light of the brightest flat capture, of full scale."
    )
    timeout_s: Annotated[float, Field(gt=0, le=120)] = Field(
        default=20.0, description="How long the frames of a capture are waited for."
    )


class NewRadiometricCapture(NewCaptureSession):
    """A session of dark and flat captures to begin."""

    settings: RadiometricCaptureSettings = Field(default_factory=RadiometricCaptureSettings)


class CapturedLevel(ResponseModel):
    """Counts of one sensor in a capture."""

    sensor: str
    mean_counts: float = Field(description="Median over the pixels of their mean counts.")
    noise_counts: float = Field(
        description="Median over the pixels of their standard deviation from frame to frame."
    )
    saturated_pixels: int = Field(description="Pixels that reached full scale in a frame.")
    flicker: float = Field(description="Relative standard deviation of the mean, frame to frame.")


class CapturedFrames(Captured):
    """One dark or flat capture."""

    name: str = Field(description="`dark`, `flat-1`, `flat-2`, ...")
    kind: Kind
    temperature_c: float | None
    relative_light: float | None = Field(description="Its light beside that of the others.")
    full_scale_counts: int
    sensors: list[CapturedLevel]


class RadiometricCapture(CaptureSession):
    """A session of dark and flat captures: what is done, and what to do next."""

    settings: RadiometricCaptureSettings
    captured: list[CapturedFrames]
    next: Kind | None = Field(description="Kind of the next capture; null: there are enough.")


Light = Annotated[float, Field(gt=0.0, le=1e12)]
Lights = Annotated[
    list[Light],
    Field(
        min_length=MIN_FLATS,
        max_length=MAX_FLATS,
        description="Light of each flat level in any unit, by the lamp or the exposure time; only "
        "with it something is known of the linearity.",
    ),
    FIRST_ERROR_ONLY,
]
Scan = Annotated[
    list[Annotated[int, Field(ge=0, le=FULL_SCALE)]],
    Field(min_length=MIN_PIXELS, max_length=MAX_PIXELS),
    FIRST_ERROR_ONLY,
]
Scans = Annotated[
    list[Scan], Field(min_length=MIN_CAPTURES, max_length=MAX_SCANS), FIRST_ERROR_ONLY
]
RecordingName = Annotated[str, StringConstraints(max_length=200, pattern=RECORDING_PATTERN)]


class FromCapture(RequestModel):
    """Estimate from a session of captures."""

    kind: Literal["capture"]
    radiometric_capture_id: Slug


class FromRecordings(RequestModel):
    """Estimate from recordings in the data directory's folder ``recordings``."""

    kind: Literal["recordings"]
    dark_recording_id: RecordingName = Field(description="Recorded with covered sensors.")
    flat_recording_ids: Annotated[
        list[RecordingName], Field(min_length=MIN_FLATS, max_length=MAX_FLATS), FIRST_ERROR_ONLY
    ] = Field(description="Recorded under even light, each with another amount of it.")
    relative_light: Lights | None = None
    temperature_c: Temperature | None = None


class SensorScans(RequestModel):
    """Scans of one sensor, all of one length."""

    dark: Scans = Field(description="Of the covered sensor.")
    flats: Annotated[
        list[Scans], Field(min_length=MIN_FLATS, max_length=MAX_FLATS), FIRST_ERROR_ONLY
    ] = Field(description="Under even light, each list with another amount of it.")


class FromScans(RequestModel):
    """Estimate from scans that are sent along."""

    kind: Literal["scans"]
    sensors: Annotated[dict[Name, SensorScans], Field(min_length=1, max_length=64)]
    full_scale_counts: int = Field(ge=255, le=FULL_SCALE, description="Largest count there is.")
    relative_light: Lights | None = None
    temperature_c: Temperature | None = None


class FromDocument(RequestModel):
    """A calibration estimated elsewhere, by `lumiline radiometric-calibration estimate`."""

    kind: Literal["document"]
    sensors: Annotated[dict[Name, dict[str, Any]], Field(min_length=1, max_length=64)] = Field(
        description="The calibration of each sensor, as `GET` returns it."
    )


class FromLines(RequestModel):
    """Measure the shape of lines from a recording of one marker that is moved through the field.

    It is added to the radiometric calibration that the device uses; without one, pixels are taken
    for equal, with the noise of the device's description.
    """

    kind: Literal["lines"]
    recording_id: RecordingName = Field(
        description="In the data directory's folder `recordings`; one marker, seen by all sensors, "
        "moved slowly over all their pixels."
    )


class FromBadPixels(RequestModel):
    """Keep the bad pixels that the frames of the running device have shown (its status).

    They are added to the radiometric calibration that it uses; without one, all other pixels are
    taken for equal, with the noise of the data sheet.
    """

    kind: Literal["bad-pixels"]


Origin = Annotated[
    FromCapture | FromRecordings | FromScans | FromDocument | FromBadPixels | FromLines,
    Field(discriminator="kind"),
]


class NewRadiometricCalibration(RequestModel):
    """A radiometric calibration to estimate and store."""

    id: Slug | None = Field(default=None, description="Left out or null: the server makes one.")
    device_id: Slug
    source: Origin
    note: Note = ""


class SensorFigures(ResponseModel):
    """Figures of a sensor's radiometric calibration (EMVA 1288)."""

    sensor: str
    pixels: int
    captures: int = Field(description="Frames that it was estimated from.")
    gain_electrons_per_count: float = Field(description="By the photon transfer curve.")
    read_noise_counts: float = Field(description="With the noise of quantisation.")
    dark_offset_counts: float = Field(description="Mean of the good pixels.")
    saturation_counts: int
    prnu: float = Field(description="Photo response non-uniformity, relative.")
    dsnu_counts: float = Field(description="Dark signal non-uniformity.")
    linearity_error: float | None = Field(
        description="Mean deviation from a straight line, relative; null: the ratios of the light "
        "were not given."
    )
    illumination_range: float = Field(
        description="Smooth variation of the light along the sensor that was removed, relative."
    )
    bad_pixels: int = Field(description="Pixels that are left out of every measurement.")
    temperature_c: float | None
    line_skewness: float | None = Field(
        description="Largest skewness of its lines along the sensor; null: not measured, they are "
        "taken for Gaussians."
    )


class RadiometricCalibrationSummary(ResponseModel):
    """A radiometric calibration without the numbers of its pixels."""

    id: str
    device_id: str
    active: bool = Field(description="Whether the device uses it now.")
    origin: Literal["capture", "recordings", "scans", "document", "bad-pixels", "lines"]
    sensors: list[SensorFigures]
    content_hash: str
    note: str
    created_at: Moment


class RadiometricCalibrationDocument(RadiometricCalibrationSummary):
    """A radiometric calibration, whole."""

    content: dict[str, Any] = Field(
        description="What is hashed: `device`, and `sensors` with the pixels of each."
    )


class RadiometricActivation(ResponseModel):
    """One change of the radiometric calibration that a device uses."""

    id: int
    device_id: str
    radiometric_id: str | None = Field(description="null: none from then on.")
    previous_radiometric_id: str | None
    activated_at: Moment
    actor: str | None
