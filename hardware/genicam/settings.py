"""Settings of the GenICam driver."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, StringConstraints

from hardware.driver import PeakMethod
from hardware.field_bounds import FIRST_ERROR_ONLY, CheckedSettings, SensorName, check_distinct
from hardware.genicam.pixel_formats import PixelFormat

_FEATURE = r"^[A-Za-z_][A-Za-z0-9_]{0,99}$"


@dataclass(frozen=True)
class GenicamCamera(CheckedSettings):
    """One camera: the sensor's name, and its identifier or network address."""

    name: SensorName
    camera: Annotated[
        str,
        StringConstraints(pattern=r"^[ -~]{1,200}$"),
        Field(description="As `lumiline cameras` lists it: its identifier, or its address."),
    ]

    def __str__(self) -> str:
        return f'sensor "{self.name}", camera {self.camera}'


@dataclass(frozen=True)
class Feature(CheckedSettings):
    """A feature of the camera by its GenICam name, and its value."""

    name: Annotated[str, StringConstraints(pattern=_FEATURE)]
    value: bool | int | float | Annotated[str, StringConstraints(max_length=200)]


@dataclass(frozen=True)
class GenicamSettings(CheckedSettings):
    """The cameras, and how they are set.

    Args:
        cameras: one for each sensor; all of one width.
        pitch_um: pixel pitch [um].
        pixel_format: how pixels are sent; it tells the counts' bits.
        width: pixels of a line; None: as the camera is set.
        offset_x: first pixel of the line, with ``width``.
        lines_per_buffer: lines that a camera sends at once (its Height). Each is an exposure.
        exposure_us: length of one exposure [us]; None: as the camera is set.
        line_rate_hz: exposures per second; None: as the camera is set.
        features: set in this order, after the rest: triggers, gains, and what else the cameras
            have.
        match_us: how far apart lines of several cameras may be exposed and still make one frame
            [us]; less than half the time between two exposures.
        electrons_per_count: gain of the conversion, from the camera's data sheet.
        read_noise_electrons: standard deviation of the read noise, likewise.
        offset_counts: the count without light (the black level).
        peaks: how the lines' peaks are measured.

    Raises:
        InvalidParameter: a value is out of its bounds, or two cameras have one name or are one.
    """

    cameras: Annotated[
        tuple[GenicamCamera, ...], Field(min_length=1, max_length=16), FIRST_ERROR_ONLY
    ]
    pitch_um: Annotated[float, Field(gt=0.0, le=1000.0)]
    pixel_format: PixelFormat = "Mono8"
    width: Annotated[int, Field(ge=8, le=65536)] | None = None
    offset_x: Annotated[int, Field(ge=0, le=65536)] = 0
    lines_per_buffer: Annotated[int, Field(ge=1, le=4096)] = 1
    exposure_us: Annotated[float, Field(gt=0.0, le=1e7)] | None = None
    line_rate_hz: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    features: Annotated[tuple[Feature, ...], Field(max_length=100), FIRST_ERROR_ONLY] = ()
    match_us: Annotated[float, Field(ge=0.0, le=1e6)] = 500.0
    electrons_per_count: Annotated[float, Field(gt=0.0, le=1e4)] = 10.0
    read_noise_electrons: Annotated[float, Field(ge=0.0, le=500.0)] = 20.0
    offset_counts: Annotated[float, Field(ge=0.0, le=65535.0)] = 0.0
    peaks: PeakMethod = "fit"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_distinct(self.cameras, "sensors", "name", "camera")
