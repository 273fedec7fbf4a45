"""Line scans and detected peaks as clients send and receive them."""

from typing import Annotated, Final, Literal

from pydantic import Field

from compute.signal.centroid_settings import MAX_PIXELS, MIN_PIXELS
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import RequestModel, ResponseModel
from service.api.line_scans.methods import Method, MethodName

MAX_SCANS: Final = 256
MAX_TOTAL_PIXELS: Final = 512 * 1024
"""Pixels of all scans of one request: 256 scans of 2048, 8 of 65536."""

DETAIL_PIXELS: Final = 65536
"""Pixels of all scans of a request in detail, whose answer has every pixel several times."""

CORRELATION_VALUES: Final = 4 * DETAIL_PIXELS
"""Values of all correlations of a request in detail, one for each reading that a line may have."""

CHAIN_PIXELS: Final = 8192
"""Pixels of a line for the chain, which keeps a line of values for each peak of a line."""

CHAIN_TOTAL_PIXELS: Final = 65536
"""Pixels of all scans of a request for the chain."""

FULL_SCALE: Final = 65535

Counts = Annotated[
    list[Annotated[int, Field(ge=0, le=FULL_SCALE)]],
    Field(min_length=MIN_PIXELS, max_length=MAX_PIXELS),
    FIRST_ERROR_ONLY,
]


class PixelNoise(RequestModel):
    """Conversion and noise of the sensor that the scans come from."""

    electrons_per_count: float = Field(ge=1e-3, le=1e6, description="Gain of the conversion.")
    read_noise_electrons: float = Field(
        ge=0.0, le=1e6, description="Standard deviation of the read noise."
    )
    offset_counts: float = Field(
        default=0.0, ge=-FULL_SCALE, le=FULL_SCALE, description="The count without light."
    )
    full_scale_counts: int = Field(
        default=FULL_SCALE, ge=1, le=FULL_SCALE, description="The count of a saturated pixel."
    )


class LineScanRequest(RequestModel):
    """Lines to look for peaks in."""

    scans: Annotated[
        list[Counts],
        Field(
            min_length=1,
            max_length=MAX_SCANS,
            description=f"Counts, one list for each line, all of one length; {MAX_TOTAL_PIXELS} "
            f"values at most, {DETAIL_PIXELS} in detail.",
        ),
        FIRST_ERROR_ONLY,
    ]
    method: Method
    noise: PixelNoise | None = Field(
        default=None, description="Null: guessed from the scans; `assumed` says how."
    )
    offset_counts: float | None = Field(
        default=None,
        ge=-FULL_SCALE,
        le=FULL_SCALE,
        description="Where `noise` is null: the count without light, if it is known; the rest is "
        "guessed, and better than without.",
    )
    detail: bool = Field(
        default=False,
        description="Also the fitted model and residuals of each pixel, the scans after each step "
        "of the chain, the matched filter's answer, or the correlation with a mask's shadow.",
    )


class LinePeak(ResponseModel):
    """One peak; what the method does not give is null."""

    position_px: float = Field(
        description="0 is the centre of the first pixel; of a mask the reading, which may lie "
        "beyond the line."
    )
    sigma_px: float | None = Field(description="Standard deviation by the noise model.")
    amplitude: float | None = Field(description="Height above the background [counts].")
    width_px: float | None = Field(
        description="Full width at the peak's threshold; of a mask's shadow, of all that is lit."
    )
    reduced_chi2: float | None = Field(description="Misfit per degree of freedom; null: no fit.")
    response_sigma: float | None = Field(
        description="The matched filter's answer, or the correlation with a mask's shadow, in "
        "standard deviations."
    )
    flags: tuple[str, ...] = Field(
        description="`saturated`, `clipped`, `merged`, `truncated`, `joint`, `poor-fit`, "
        "`unfitted`; of masks also `ambiguous`."
    )


class FitWindow(ResponseModel):
    """Pixels that were fitted together, and the stripes in them; null where no fit was possible."""

    first_px: int
    values: list[float]
    used: list[bool] = Field(description="False: at full scale, left out.")
    model: list[float | None] = Field(description="Expected counts.")
    residual_sigma: list[float | None] = Field(
        description="Values less model, in standard deviations."
    )
    position_px: list[float]
    sigma_px: list[float | None]
    light_counts: list[float | None] = Field(description="Light of each stripe.")
    light_electrons: list[float | None]
    width_px: float | None = Field(description="Standard deviation of the stripes.")
    width_sigma_px: float | None
    background_counts: float | None = Field(description="In the window's middle.")
    slope_counts_per_px: float | None
    parameters: list[str] = Field(
        description="Of the covariance's rows; of a mask's shadow its position alone."
    )
    covariance: list[list[float | None]] = Field(
        description="Lights in counts, the width as its logarithm."
    )
    chi2: float | None
    dof: int


class Stage(ResponseModel):
    """A line on its way."""

    name: str
    unit: str = Field(description="`counts`, or `deviations` of the noise.")
    shift_px: float = Field(
        description="By how much filters have moved it to the right so far: value k is of the "
        "place k - shift_px, of a mask's correlation of that reading."
    )
    values: list[float] = Field(
        description="Longer than the line by what a filter with `delay` delays it; of a mask's "
        "correlation one for each reading that it may have."
    )


class LineScan(ResponseModel):
    """Peaks of one line scan."""

    index: int = Field(description="Its number; of averaged scans the first.")
    sensor: str | None = Field(default=None, description="Of a recording; null for posted scans.")
    background_counts: float = Field(description="Between the peaks.")
    noise_counts: float = Field(
        description="Standard deviation of a pixel at the background, by the noise model."
    )
    measured_noise_counts: float = Field(
        description="The same, measured between the peaks; 0.58 is the least that is measured."
    )
    saturated_pixels: int = Field(
        description="Pixels at full scale; where all are, a line has no peaks to find."
    )
    limit_counts: float | None = Field(
        description="A peak's highest pixel reaches at least this, in the scan's middle where the "
        "background slopes; null: the method has no such limit."
    )
    limit_sigma: float | None = Field(
        description="The matched filter's answer, or the correlation with a mask's shadow, is "
        "above this; null for other methods."
    )
    further_peaks: int | None = Field(
        description="How many of the peaks are there only because the fit explains the pixels "
        "better with them; a bright line that is not Gaussian is split so. Null: none were tried."
    )
    peaks: list[LinePeak]
    covariance_px2: list[list[float]] | None = Field(
        description="Of the peaks' positions; null where none were fitted together."
    )
    windows: list[FitWindow] | None
    stages: list[Stage] | None


class LineScans(ResponseModel):
    """Peaks of line scans."""

    method: MethodName
    noise: PixelNoise = Field(description="As given, or as guessed.")
    assumed: list[str] = Field(description="What was guessed, and how; empty: nothing.")
    scans: list[LineScan]


class DeviceScan(ResponseModel):
    """One sensor's scan of an exposure, and what the device's own method found in it."""

    sensor: str = Field(description="Its name.")
    counts: list[int] = Field(description="Of its pixels, as they came.")
    background_counts: float = Field(description="Between the peaks.")
    noise_counts: float = Field(
        description="Standard deviation of a pixel at the background, by the noise model."
    )
    threshold_counts: float | None = Field(
        description="A peak's highest pixel reaches at least this, in the scan's middle where the "
        "background slopes; null: the method has no such limit."
    )
    full_scale_counts: int = Field(description="The count of a saturated pixel.")
    saturated_pixels: int = Field(description="Pixels at full scale.")
    masked_pixels: list[int] = Field(description="Bad pixels, which no peak is measured with.")
    peaks: list[LinePeak] = Field(description="As the stream has them.")
    windows: list[FitWindow] | None = Field(
        description="Fits, of the sensor whose detail was asked for; null: of another, or the "
        "method fits nothing."
    )


class DeviceScans(ResponseModel):
    """The scans of one exposure of a running device."""

    device_id: str
    sequence: int = Field(description="The exposure's number.")
    exposure_ns: int = Field(description="Its middle on the host's clock [ns].")
    marker: int | None = Field(description="The strobed marker; null: all are lit.")
    method: Literal["fit", "centroid", "shadow"] | None = Field(
        description="How peaks are measured; null: no method reads these scans."
    )
    radiometric_id: str | None = Field(description="The peaks' radiometric calibration.")
    scans: list[DeviceScan] = Field(description="In the order of the device's sensors.")
