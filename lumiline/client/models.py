"""Models of the server's answers; further members of a newer server become attributes."""
# Made from the OpenAPI document by docs/generators/client_code.py; edit nothing here.

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict


class ResponseModel(BaseModel):
    """Base of the models of the server's answers."""

    model_config = ConfigDict(frozen=True, extra="allow", defer_build=True, protected_namespaces=())


class CalibrationTarget(ResponseModel):
    """The thesis's pyramidal calibration frame with 19 markers, at rest (Figure 5.8)."""

    kind: Literal["calibration-frame"]
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 1500.0)
    scale: float = 1.0


class StillPoints(ResponseModel):
    """Markers at rest at given points."""

    points_mm: tuple[tuple[float, float, float], ...]
    kind: Literal["still-points"]


class ShiftedPoints(ResponseModel):
    """Markers on somebody who rests, and moves aside for the last part of every period."""

    points_mm: tuple[tuple[float, float, float], ...]
    shift_mm: tuple[float, float, float] = (5.0, 0.0, 0.0)
    period_s: float = 10.0
    away: float = 0.4
    moving_s: float = 0.1
    kind: Literal["shifted-points"]


class RotatingBar(ResponseModel):
    """A bar that turns at constant speed about its middle, a marker at each end (section
    6.1.2).
    """

    kind: Literal["rotating-bar"]
    length_mm: float = 292.0
    period_s: float = 2.0
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 1500.0)
    plane_normal: tuple[float, float, float] = (0.0, 1.0, 0.0)


class MovingTool(ResponseModel):
    """A rigid tool that is moved smoothly in all six degrees of freedom."""

    markers_mm: tuple[tuple[float, float, float], ...]
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 1500.0)
    swing_mm: tuple[float, float, float] = (120.0, 90.0, 60.0)
    turn_rad: tuple[float, float, float] = (0.4, 0.5, 0.6)
    rest_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    held_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    period_s: float = 6.0
    phase: float = 0.0


class MovingTools(ResponseModel):
    """Rigid tools in motion; their markers are numbered tool by tool, in order."""

    tools: tuple[MovingTool, ...]
    moving: bool = True
    kind: Literal["moving-tools"]


class WavedWand(ResponseModel):
    """A wand of two markers that is waved through a volume in all directions, for calibration."""

    kind: Literal["waved-wand"]
    length_mm: float = 300.0
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 1500.0)
    swing_mm: tuple[float, float, float] = (250.0, 250.0, 300.0)
    period_s: float = 30.0


class EvenLight(ResponseModel):
    """Even light on all pixels and no marker, for radiometric calibration."""

    electrons: float = 0.0
    kind: Literal["even-light"]


class StrobeSchedule(ResponseModel):
    """A cyclic sequence of slots, one exposure each; each slot lights one marker, or all."""

    slots: tuple[int | None, ...]


class BlinkSchedule(ResponseModel):
    """Cyclic code words of the markers, one bit per exposure, each with its own phase."""

    words: tuple[str, ...]
    low: float = 0.4
    phases: tuple[int, ...] | None = None


class PixelDefects(ResponseModel):
    """Differences of the pixels and bad pixels, drawn for each sensor from a seed."""

    response_nonuniformity: float = 0.01
    offset_nonuniformity_counts: float = 2.0
    dead_pixels: int = 1
    hot_pixels: int = 1
    stuck_pixels: int = 1
    hot_electrons: float = 3000.0
    seed: int = 1


class BarPlacement(ResponseModel):
    """Place and rotation of a bar in a hall, whose time is the host's."""

    position_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay_ms: float = 0.0


class SimulationSettings(ResponseModel):
    """What the simulated device shows, and how its sensors see it."""

    scene: (
        CalibrationTarget
        | StillPoints
        | ShiftedPoints
        | RotatingBar
        | MovingTools
        | WavedWand
        | EvenLight
        | None
    ) = None
    frame_rate_hz: float = 1000.0
    illumination: str = "strobed"
    strobe: StrobeSchedule | None = None
    blink: BlinkSchedule | None = None
    spot_sigma_px: float = 2.0
    signal_electrons: float = 100000.0
    distance_falloff: bool = True
    ambient_electrons: float = 400.0
    read_noise_electrons: float = 30.0
    full_well_electrons: float = 60000.0
    electrons_per_count: float = 12.0
    offset_counts: float = 64.0
    bits: int = 12
    pixels: PixelDefects | None = None
    seed: int = 1
    peaks: str = "fit"
    placement: BarPlacement | None = None
    duration_s: float | None = None
    realtime: bool = True


class SimulatedSource(ResponseModel):
    """Line scans from the simulator."""

    kind: Literal["simulated"]
    settings: SimulationSettings | None = None


class ProfileSettings(ResponseModel):
    """What a profile's device shows, and how it is simulated."""

    scene: (
        CalibrationTarget
        | StillPoints
        | ShiftedPoints
        | RotatingBar
        | MovingTools
        | WavedWand
        | EvenLight
        | None
    ) = None
    optics: str = "tabulated"
    frame_rate_hz: float | None = None
    illumination: str | None = None
    seed: int = 1
    pattern_seed: int = 1
    peaks: str = "fit"
    duration_s: float | None = None
    realtime: bool = True


class ProfileSource(ResponseModel):
    """Line scans of a device simulated from its profile: its optics, light and detector."""

    kind: Literal["profile"]
    profile_id: str
    settings: ProfileSettings | None = None


class ReplaySource(ResponseModel):
    """Line scans from a recording in the data directory's folder ``recordings``."""

    kind: Literal["replay"]
    recording_id: str
    speed: float | None = 1.0


class SerialSettings(ResponseModel):
    """Port of a device, and settings sent to it."""

    url: str
    baudrate: int = 921600
    silent_after_s: float = 1.0
    frame_rate_hz: float | None = None
    exposure_us: float | None = None
    strobe: StrobeSchedule | None = None
    peaks: str = "fit"


class SerialSource(ResponseModel):
    """A device on a serial port with the line-scan protocol (docs/reference/serial-
    protocol.md).
    """

    kind: Literal["serial"]
    settings: SerialSettings


class Tcd1304Board(ResponseModel):
    """One board: the sensor's name, and where its serial port is."""

    name: str
    port: str


class Tcd1304Settings(ResponseModel):
    """The boards, and how their lines are taken."""

    boards: tuple[Tcd1304Board, ...]
    exposure_us: float = 7388.0
    averages: int = 1
    clock_hz: int = 2000000
    baud_rate: int = 115200
    gap_ms: float = 50.0
    saturated_at: int = 0
    electrons_per_count: float = 30.0
    read_noise_electrons: float = 75.0
    peaks: str = "fit"


class Tcd1304Source(ResponseModel):
    """Open TCD1304 boards, each at a serial port (docs/how-to/tcd1304.md)."""

    kind: Literal["tcd1304"]
    settings: Tcd1304Settings


class GenicamCamera(ResponseModel):
    """One camera: the sensor's name, and its identifier or network address."""

    name: str
    camera: str


class Feature(ResponseModel):
    """A feature of the camera by its GenICam name, and its value."""

    name: str
    value: bool | int | float | str


class GenicamSettings(ResponseModel):
    """The cameras, and how they are set."""

    cameras: tuple[GenicamCamera, ...]
    pitch_um: float
    pixel_format: str = "Mono8"
    width: int | None = None
    offset_x: int = 0
    lines_per_buffer: int = 1
    exposure_us: float | None = None
    line_rate_hz: float | None = None
    features: tuple[Feature, ...] = ()
    match_us: float = 500.0
    electrons_per_count: float = 10.0
    read_noise_electrons: float = 20.0
    offset_counts: float = 0.0
    peaks: str = "fit"


class GenicamSource(ResponseModel):
    """GenICam line-scan cameras, GigE Vision or USB3 Vision (docs/how-to/genicam.md)."""

    kind: Literal["genicam"]
    settings: GenicamSettings


class FusionSettings(ResponseModel):
    """How the frames of several bars are put together."""

    max_wait_ms: float = 50.0
    clock_uncertainty_us: float = 50.0


class FusionSource(ResponseModel):
    """The peaks of two bars or more that see one volume (docs/how-to/fusion.md)."""

    kind: Literal["fusion"]
    bars: tuple[str, ...]
    settings: FusionSettings | None = None


class Sensor(ResponseModel):
    """One line sensor: name, number of pixels, pixel pitch [um]."""

    name: str
    pixels: int
    pitch_um: float


class ExternalSource(ResponseModel):
    """No driver: a program of yours reads the sensors and posts peak positions."""

    kind: Literal["external"]
    sensors: tuple[Sensor, ...]


class Blinking(ResponseModel):
    """The codes that markers show, one bit an exposure, again and again."""

    words: tuple[str, ...]
    off_level: float = 0.4
    miss_probability: float = 0.05


class Tracking(ResponseModel):
    """Settings of tracking markers and tools of a running device; all have defaults."""

    tracks: str = "never"
    motion: str = "interacting"
    acceleration_psd: float = 10000.0
    jerk_psd: float = 100000000.0
    coast_s: float = 1.0
    blinking: Blinking | None = None
    tool_acceleration_mm_s2: float = 3000.0
    tool_angular_acceleration_rad_s2: float = 30.0
    tool_coast_s: float = 0.1
    tool_tip_sd_mm: float = 1.0
    tool_max_detectable_sigma: float | None = 15.0
    volume_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None


class Device(ResponseModel):
    """A device."""

    id: str
    title: str
    station: str | None
    source: (
        SimulatedSource
        | ProfileSource
        | ReplaySource
        | SerialSource
        | Tcd1304Source
        | GenicamSource
        | FusionSource
        | ExternalSource
    )
    sensors: tuple[Sensor, ...]
    autostart: bool
    tracking: Tracking
    active_calibration_id: str | None
    active_table_id: str | None
    active_radiometric_id: str | None
    created_at: datetime
    updated_at: datetime


class LinkCounters(ResponseModel):
    """Traffic and error counters of a link since the driver was opened."""

    received_bytes: int = 0
    frames_received: int = 0
    frames_garbled: int = 0
    frames_incomplete: int = 0
    frames_lost: int = 0
    reconnects: int = 0
    clock_restarts: int = 0


class LinkState(ResponseModel):
    """State of a link."""

    state: str
    reason: str | None = None
    counters: LinkCounters | None = None
    clock_uncertainty_us: float | None = None
    clock_rate_ppm: float | None = None
    temperature_c: float | None = None


class LiveBadPixel(ResponseModel):
    """A pixel that a device's frames have shown to be bad since it was started; it is masked."""

    sensor: str
    pixel: int
    kind: str
    found_at: datetime


class DeviceStateDocument(ResponseModel):
    """State and counters of a device."""

    state: str
    reason: str | None = None
    calibration_id: str | None = None
    table_id: str | None = None
    frames_received: int = 0
    frames_lost: int = 0
    frames_dropped_compute: int = 0
    frames_processed: int = 0
    subscribers: int = 0
    link: LinkState | None = None
    frames_not_tracked: int = 0
    radiometric_id: str | None = None
    bad_pixels: tuple[LiveBadPixel, ...] = ()
    device_id: str


class Activation(ResponseModel):
    """One move of the pointer to the active calibration."""

    id: int
    device_id: str
    calibration_id: str
    previous_calibration_id: str | None
    table_id: str | None
    previous_table_id: str | None
    restores_id: int | None
    activated_at: datetime
    actor: str | None


class CalibratedProfile(ResponseModel):
    """The device profile that a nominal calibration was computed from."""

    profile_id: str
    content_hash: str


class CalibrationSummary(ResponseModel):
    """A calibration without its numbers."""

    id: str
    device_id: str
    state: str
    provenance: str
    method: str
    note: str
    point_count: int
    content_hash: str
    profile: CalibratedProfile | None = None
    created_at: datetime
    retired_at: datetime | None


class ParentCalibration(ResponseModel):
    """The calibration that an updated one was made from."""

    id: str
    content_hash: str


class Reading(ResponseModel):
    """One reading with its standard deviation."""

    position_px: float
    sigma_px: float


class ControlPoint(ResponseModel):
    """A point of known position and what the sensors read of it."""

    name: str
    position_mm: tuple[float, float, float]
    readings: dict[str, float | Reading]


class FieldDistortion(ResponseModel):
    """A lens's contribution to the field angle u that is read, ``sum a_ij u^i v^j``."""

    terms: tuple[tuple[int, int], ...]
    coefficients: tuple[float, ...]
    offset_y_mm: float = 0.0
    row_behind_mm: float = 0.0


class SensorModel(ResponseModel):
    """One calibrated linear sensor: ``p = p0 + c x/z`` with ``(x, z)`` in the sensor's frame."""

    name: str
    pixels: int
    principal_distance_px: float
    principal_point_px: float
    rotation_vector_rad: tuple[float, float, float]
    offset_x_mm: float
    offset_z_mm: float
    cubic_per_px2: float = 0.0
    distortion: FieldDistortion | None = None


class SensorFit(ResponseModel):
    """One sensor's fitted model and how well it fits."""

    model: SensorModel
    points: int
    rms_px: float
    max_px: float
    sigma_px: float
    sigma_source: str
    chi2_per_dof: float | None


class CalibrationSettings(ResponseModel):
    """Settings of a calibration."""

    distortion: str | tuple[tuple[int, int], ...] = "none"
    position_sigma_mm: float | None = None
    loss: str = "linear"
    labels: str = "off"


class DistortionEstimate(ResponseModel):
    """The distortion terms of a calibration, their size, and the reason for them."""

    chosen: str
    reason: str
    scale: float | None = None
    scale_range: tuple[float, float] | None = None
    edge_px: float | None = None
    log_evidence_ratio: float | None = None


class LabelFinding(ResponseModel):
    """One label error, or one outlier."""

    kind: str
    sensor: str | None
    points: tuple[int, ...]
    probability: float
    residual_px: tuple[float | None, ...]
    normalised_residual: tuple[float | None, ...]


class AxisErrors(ResponseModel):
    """Statistics of differences X, Y, Z, reconstructed minus given points [mm]."""

    points: int
    mean_absolute_mm: tuple[float, float, float]
    max_absolute_mm: tuple[float, float, float]
    mean_mm: tuple[float, float, float]
    standard_deviation_mm: tuple[float, float, float]


class CrossValidation(ResponseModel):
    """Control points and readings predicted by calibrations fitted without them."""

    scheme: str
    groups: int
    errors: AxisErrors | None
    differences_mm: tuple[tuple[float, float, float] | None, ...]
    reading_rms_px: tuple[float | None, ...]


class SensorDiagnosis(ResponseModel):
    """Precision of one sensor's parameters by the geometry of the control points."""

    sensor: str
    condition: float
    weakest: tuple[tuple[str, float], ...]
    weakest_description: str
    pixels: tuple[float, float]
    pixel_share: float
    field_u: tuple[float, float]
    field_v: tuple[float, float] | None
    depth_mm: tuple[float, float]


class Suggestion(ResponseModel):
    """A suggested further control point and the precision with it."""

    position_mm: tuple[float, float, float]
    mean_sigma_mm: float
    max_sigma_mm: float


class Diagnosis(ResponseModel):
    """Precision of a calibration by its control points, and the points that would improve it."""

    sensors: tuple[SensorDiagnosis, ...]
    mean_sigma_mm: float | None
    max_sigma_mm: float | None
    suggestions: tuple[Suggestion, ...]
    remarks: tuple[str, ...]


class Calibration(ResponseModel):
    """The camera models of one device with their uncertainty."""

    method: str
    sensors: tuple[SensorFit, ...]
    covariance: tuple[tuple[float, ...], ...]
    residuals_px: tuple[tuple[float | None, ...], ...]
    settings: CalibrationSettings | None = None
    distortion: DistortionEstimate | None = None
    reading_weights: tuple[tuple[float | None, ...], ...] | None = None
    point_shifts_mm: tuple[tuple[float, float, float], ...] | None = None
    labels: tuple[LabelFinding, ...] = ()
    cross_validation: tuple[CrossValidation, ...] = ()
    diagnosis: Diagnosis | None = None


class PointErrors(ResponseModel):
    """Differences between given and reconstructed control points."""

    statistics: AxisErrors | None
    differences_mm: tuple[tuple[float, float, float] | None, ...]
    readings: int | None = None


class LengthErrors(ResponseModel):
    """Known lengths of a waved target as they were measured at poses that the cameras never
    saw.
    """

    poses: int
    lengths: int
    rms_mm: float
    mean_mm: float
    max_mm: float


class ControlPointErrors(ResponseModel):
    """Errors of a calibration at its control points, or of the lengths of a waved target."""

    fitted: PointErrors | None
    leave_one_out: PointErrors | None
    blocks_left_out: PointErrors | None = None
    lengths_left_out: LengthErrors | None = None


class CalibrationDocument(ResponseModel):
    """A calibration, whole."""

    id: str
    device_id: str
    state: str
    provenance: str
    method: str
    note: str
    point_count: int
    content_hash: str
    profile: CalibratedProfile | None = None
    created_at: datetime
    retired_at: datetime | None
    parent: ParentCalibration | None = None
    points: tuple[ControlPoint, ...]
    result: Calibration
    errors: ControlPointErrors


class ParameterDifference(ResponseModel):
    """One parameter of one sensor."""

    sensor: str
    parameter: str
    one: float | None
    other: float | None
    difference: float
    sigmas: float | None


class PositionDifferences(ResponseModel):
    """Differences of positions by two calibrations from the same readings."""

    points: int
    low_mm: tuple[float, float, float]
    high_mm: tuple[float, float, float]
    mean_mm: tuple[float, float, float]
    rms_mm: float
    max_mm: float
    aligned_rms_mm: float
    rms_sigma: float | None


class SameObservations(ResponseModel):
    """Both calibrations on the control points of one of them."""

    of: str
    points: int
    one_rms_mm: float
    other_rms_mm: float
    left_out: bool
    better: str


class Comparison(ResponseModel):
    """Two calibrations beside one another."""

    parameters: tuple[ParameterDifference, ...]
    positions: PositionDifferences | None
    observations: tuple[SameObservations, ...]


class ComparisonDocument(ResponseModel):
    """Two calibrations of one device beside one another."""

    calibration_id: str
    other_calibration_id: str
    comparison: Comparison


class RunProblem(ResponseModel):
    """Why a run failed: the members of a problem document (RFC 9457)."""

    type: str
    title: str
    status: int
    detail: str
    context: dict[str, Any] | None = None


class Run(ResponseModel):
    """A computation beside the requests, and what became of it."""

    id: str
    kind: str
    device_id: str
    state: str
    progress: float
    stage: str
    result_id: str | None
    result_path: str | None
    problem: RunProblem | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None


class CaptureSettings(ResponseModel):
    """How each target is captured."""

    frames: int = 50
    marker: int | None = None
    seen_share: float = 0.8
    timeout_s: float = 10.0
    still_px: float = 0.5


class CapturesTarget(ResponseModel):
    """A named place at which a marker will be held, or has its own."""

    name: str
    position_mm: tuple[float, float, float]
    marker: int | None = None


class CapturedSensor(ResponseModel):
    """What one sensor read of a target."""

    sensor: str
    frames: int
    mean_px: float
    spread_px: float
    stated_px: float | None
    sigma_px: float


class CapturedTarget(ResponseModel):
    """What was read of a target."""

    frames: int
    captured_at: datetime
    target: str
    sensors: tuple[CapturedSensor, ...]


class Capture(ResponseModel):
    """A capture session: what is done and what is left."""

    id: str
    device_id: str
    instruction: str
    left: int
    note: str
    created_at: datetime
    updated_at: datetime
    recording_id: str | None
    settings: CaptureSettings
    targets: tuple[CapturesTarget, ...]
    captured: tuple[CapturedTarget, ...]
    next: str | None


class WandTarget(ResponseModel):
    """Markers on a line at known places."""

    kind: Literal["wand"]
    position_mm: tuple[float, ...]
    sigma_mm: float = 0.0


class BodyTarget(ResponseModel):
    """A rigid body, or calibration frame, of known shape."""

    kind: Literal["rigid-body"]
    marker_mm: tuple[tuple[float, float, float], ...]
    sigma_mm: float = 0.0


class UnknownTarget(ResponseModel):
    """A rigid body of unknown shape, with one known distance for the scale."""

    kind: Literal["unknown-body"]
    markers: int
    first: int
    second: int
    length_mm: float
    sigma_mm: float = 0.0


class WaveSettings(ResponseModel):
    """When the taking of poses ends."""

    duration_s: float = 180.0
    end_when_enough: bool = True


class WaveExposures(ResponseModel):
    """Exposures of the target's first marker, counted by whether they gave a pose."""

    all: int
    taken: int
    still: int
    too_few_sensors: int
    not_lit: int


class WaveSensor(ResponseModel):
    """Coverage of one sensor by readings of the target."""

    sensor: str
    clear: int
    unclear: int
    unseen: int
    readings: int
    cells: tuple[int, ...]
    wanted: int
    covered: float


class WaveDirections(ResponseModel):
    """Directions of the wand in the device's frame: z towards the sensors, x along the pixels
    of the first sensor.
    """

    rms: tuple[float, float, float]
    rings: tuple[int, ...]
    bins: tuple[int, ...]
    wanted: int


class WaveVolume(ResponseModel):
    """Volume that the target was in, in the device's frame."""

    extent_mm: tuple[float, float, float]
    octants: tuple[int, ...]


class WaveProgress(ResponseModel):
    """Coverage of a wave so far, and what is missing."""

    poses: int
    wanted_poses: int
    exposures: WaveExposures
    sensors: tuple[WaveSensor, ...]
    directions: WaveDirections | None
    volume: WaveVolume | None
    missing: tuple[str, ...]
    enough: bool


class WaveCapture(ResponseModel):
    """A session: what has been covered, what is missing, what to do next."""

    id: str
    device_id: str
    instruction: str
    left: int
    note: str
    created_at: datetime
    updated_at: datetime
    target: WandTarget | BodyTarget | UnknownTarget
    markers: tuple[int, ...]
    settings: WaveSettings
    state: str
    ended: str | None
    progress: WaveProgress


class RadiometricCaptureSettings(ResponseModel):
    """Settings of capturing dark and flat frames."""

    frames: int = 128
    levels: int = 6
    max_level: float = 0.85
    timeout_s: float = 20.0


class CapturedLevel(ResponseModel):
    """Counts of one sensor in a capture."""

    sensor: str
    mean_counts: float
    noise_counts: float
    saturated_pixels: int
    flicker: float


class CapturedFrames(ResponseModel):
    """One dark or flat capture."""

    frames: int
    captured_at: datetime
    name: str
    kind: str
    temperature_c: float | None
    relative_light: float | None
    full_scale_counts: int
    sensors: tuple[CapturedLevel, ...]


class RadiometricCapture(ResponseModel):
    """A session of dark and flat captures: what is done, and what to do next."""

    id: str
    device_id: str
    instruction: str
    left: int
    note: str
    created_at: datetime
    updated_at: datetime
    settings: RadiometricCaptureSettings
    captured: tuple[CapturedFrames, ...]
    next: str | None


class SensorFigures(ResponseModel):
    """Figures of a sensor's radiometric calibration (EMVA 1288)."""

    sensor: str
    pixels: int
    captures: int
    gain_electrons_per_count: float
    read_noise_counts: float
    dark_offset_counts: float
    saturation_counts: int
    prnu: float
    dsnu_counts: float
    linearity_error: float | None
    illumination_range: float
    bad_pixels: int
    temperature_c: float | None
    line_skewness: float | None


class RadiometricCalibrationSummary(ResponseModel):
    """A radiometric calibration without the numbers of its pixels."""

    id: str
    device_id: str
    active: bool
    origin: str
    sensors: tuple[SensorFigures, ...]
    content_hash: str
    note: str
    created_at: datetime


class RadiometricCalibrationDocument(ResponseModel):
    """A radiometric calibration, whole."""

    id: str
    device_id: str
    active: bool
    origin: str
    sensors: tuple[SensorFigures, ...]
    content_hash: str
    note: str
    created_at: datetime
    content: dict[str, Any]


class RadiometricActivation(ResponseModel):
    """One change of the radiometric calibration that a device uses."""

    id: int
    device_id: str
    radiometric_id: str | None
    previous_radiometric_id: str | None
    activated_at: datetime
    actor: str | None


class SensorDrift(ResponseModel):
    """Drift test of one sensor."""

    sensor: str
    readings: int
    rms_px: float
    p_value: float
    moved: bool
    parameter: str | None
    description: str
    change: float | None
    change_sigma: float | None
    p_value_with_change: float | None


class DriftCheck(ResponseModel):
    """Drift test of a device."""

    good: bool
    p_value: float
    chi2: float
    dof: int
    rigid_motion: bool
    rotation_rad: float | None
    translation_mm: float | None
    sensors: tuple[SensorDrift, ...]


class StationaryMarker(ResponseModel):
    """A still marker as it is stored: with its earlier readings, where it has any."""

    name: str
    position_mm: tuple[float, float, float] | None = None
    readings: dict[str, float | Reading]
    earlier: dict[str, float | Reading] | None = None


class DriftCheckDocument(ResponseModel):
    """A drift check, whole."""

    id: str
    device_id: str
    calibration_id: str
    status: str
    moved: tuple[str, ...]
    in_words: tuple[str, ...]
    against: str
    markers: int
    capture_id: str | None
    earlier_capture_id: str | None
    position_sigma_mm: float
    note: str
    created_at: datetime
    check: DriftCheck
    points: tuple[StationaryMarker, ...]


class DriftCheckSummary(ResponseModel):
    """A drift check and its findings."""

    id: str
    device_id: str
    calibration_id: str
    status: str
    moved: tuple[str, ...]
    in_words: tuple[str, ...]
    against: str
    markers: int
    capture_id: str | None
    earlier_capture_id: str | None
    position_sigma_mm: float
    note: str
    created_at: datetime
    check: DriftCheck


class Grid(ResponseModel):
    """The box of voxels."""

    origin_mm: tuple[float, float, float]
    pitch_mm: tuple[float, float, float]
    cells: tuple[int, int, int]


class CorrectionTableDocument(ResponseModel):
    """A correction table, without its numbers."""

    id: str
    device_id: str
    calibration_id: str
    calibration_hash: str
    content_hash: str
    active: bool
    origin: str
    note: str
    sensors: tuple[str, ...]
    grid: Grid
    degree: str
    valid_share: tuple[float, ...]
    max_correction_px: tuple[float, ...]
    settings: dict[str, Any]
    validation: dict[str, Any]
    made_at: datetime
    created_at: datetime


class ReconstructionSummary(ResponseModel):
    """A reconstruction without its points."""

    id: str
    device_id: str
    calibration_id: str
    table_id: str | None
    point_count: int
    created_at: datetime


class ObservedPoint(ResponseModel):
    """A point of unknown position and what the sensors read of it."""

    name: str
    readings: dict[str, float | Reading]


class NamedEstimate(ResponseModel):
    """A reconstructed point under its name."""

    position_mm: tuple[float, float, float] | None
    covariance_mm2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    residual_sigma: float | None
    sensors: tuple[str, ...]
    flags: tuple[str, ...]
    name: str
    excluded: tuple[str, ...] = ()
    detectable_px: dict[str, float | None] | None = None
    external_reliability_mm: float | None = None


class Reconstruction(ResponseModel):
    """A reconstruction: readings and estimates, in the order of the points."""

    id: str
    device_id: str
    calibration_id: str
    table_id: str | None
    point_count: int
    created_at: datetime
    points: tuple[ObservedPoint, ...]
    estimates: tuple[NamedEstimate, ...]


class UsedCalibration(ResponseModel):
    """A calibration that results were made with, whole in the file."""

    calibration_id: str | None
    content_hash: str | None
    table_id: str | None
    radiometric_id: str | None
    bad_pixels: int
    from_frame: int | None


class RecordingDetail(ResponseModel):
    """A recording with the calibrations of its results."""

    id: str
    device_id: str | None
    state: str
    reason: str | None
    contents: tuple[str, ...]
    frames_written: int | None
    duration_s: float | None
    frames_missing: int | None
    frames_dropped_compute: int | None
    frames_dropped_writer: int | None
    frames_refused: int | None
    size_bytes: int
    started_at: datetime | None
    updated_at: datetime
    gateway: str | None = None
    calibrations: tuple[UsedCalibration, ...]


class RecordingDocument(ResponseModel):
    """A recording. What is null is not known, because the file cannot be read."""

    id: str
    device_id: str | None
    state: str
    reason: str | None
    contents: tuple[str, ...]
    frames_written: int | None
    duration_s: float | None
    frames_missing: int | None
    frames_dropped_compute: int | None
    frames_dropped_writer: int | None
    frames_refused: int | None
    size_bytes: int
    started_at: datetime | None
    updated_at: datetime
    gateway: str | None = None


class RetentionDocument(ResponseModel):
    """Retention of recordings: limits, where null is none, and deletions."""

    max_age_s: float | None
    max_total_bytes: int | None
    checked_at: datetime | None
    total_bytes: int
    held_recording_ids: tuple[str, ...]
    deleted_recordings: int
    deleted_bytes: int


class RecordedPoint(ResponseModel):
    """A point: as it was found while it was recorded, or worked out now from the same frame."""

    marker: int | None
    position_mm: tuple[float, float, float] | None
    covariance_mm2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    residual_sigma: float | None
    sensors: tuple[str, ...]
    flags: tuple[str, ...]


class RecordedTrack(ResponseModel):
    """A track of a marker in a recorded frame, as in the stream."""

    id: int
    marker: int | None
    state: str
    flags: tuple[str, ...]
    position_mm: tuple[float, float, float]
    covariance_mm2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    velocity_mm_s: tuple[float, float, float]
    velocity_covariance_mm2_s2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    acceleration_mm_s2: tuple[float, float, float] | None
    peaks: tuple[int | None, ...]
    nis: float | None
    dof: int


class RecordedToolPose(ResponseModel):
    """The pose of a tool in a recorded frame, in world coordinates, as in the stream."""

    tool_id: str
    status: str
    reason: str | None
    translation_mm: tuple[float, float, float] | None
    rotation: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    quaternion_wxyz: tuple[float, float, float, float] | None
    covariance: (
        tuple[
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
        ]
        | None
    )
    tip_mm: tuple[float, float, float] | None
    tip_covariance_mm2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    residual_sigma: float | None
    markers_used: int
    readings_used: int
    velocity_mm_s: tuple[float, float, float] | None
    angular_velocity_rad_s: tuple[float, float, float] | None
    detectable_sigma: float | None
    external_tip_mm: float | None
    external_rotation_rad: float | None


class RecordedFrame(ResponseModel):
    """One frame of a recording, with its points."""

    number: int
    sequence: int
    exposure_ns: int
    marker: int | None
    points: tuple[RecordedPoint, ...]
    tracks: tuple[RecordedTrack, ...] | None
    tools: tuple[RecordedToolPose, ...] | None


class RecordedFrames(ResponseModel):
    """Consecutive frames of a recording."""

    recording_id: str
    calibration_id: str | None
    frames_written: int
    frames: tuple[RecordedFrame, ...]


class LinePeak(ResponseModel):
    """One peak; what the method does not give is null."""

    position_px: float
    sigma_px: float | None
    amplitude: float | None
    width_px: float | None
    reduced_chi2: float | None
    response_sigma: float | None
    flags: tuple[str, ...]


class FitWindow(ResponseModel):
    """Pixels that were fitted together, and the stripes in them; null where no fit was
    possible.
    """

    first_px: int
    values: tuple[float, ...]
    used: tuple[bool, ...]
    model: tuple[float | None, ...]
    residual_sigma: tuple[float | None, ...]
    position_px: tuple[float, ...]
    sigma_px: tuple[float | None, ...]
    light_counts: tuple[float | None, ...]
    light_electrons: tuple[float | None, ...]
    width_px: float | None
    width_sigma_px: float | None
    background_counts: float | None
    slope_counts_per_px: float | None
    parameters: tuple[str, ...]
    covariance: tuple[tuple[float | None, ...], ...]
    chi2: float | None
    dof: int


class DeviceScan(ResponseModel):
    """One sensor's scan of an exposure, and what the device's own method found in it."""

    sensor: str
    counts: tuple[int, ...]
    background_counts: float
    noise_counts: float
    threshold_counts: float | None
    full_scale_counts: int
    saturated_pixels: int
    masked_pixels: tuple[int, ...]
    peaks: tuple[LinePeak, ...]
    windows: tuple[FitWindow, ...] | None


class DeviceScans(ResponseModel):
    """The scans of one exposure of a running device."""

    device_id: str
    sequence: int
    exposure_ns: int
    marker: int | None
    method: str | None
    radiometric_id: str | None
    scans: tuple[DeviceScan, ...]


class Export(ResponseModel):
    """A file that an export run has made, and of what."""

    id: str
    format: str
    file_name: str
    media_type: str
    size_bytes: int
    created_at: datetime
    gateway: str | None = None
    run_id: str | None
    device_id: str | None
    recording_id: str | None


class Tip(ResponseModel):
    """Working point of a tool, and where it is known from."""

    position_mm: tuple[float, float, float] | None
    covariance_mm2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    ) = None
    tool_calibration_id: str | None = None
    axis: tuple[float, float, float] | None = None


class ToolLimits(ResponseModel):
    """When a pose is not good enough to be used."""

    tip_sd_mm: float | None = None


class Origin(ResponseModel):
    """Origin of a tool's geometry: given, or captured."""

    kind: str
    frames: int | None = None
    sigma_mm: tuple[float, ...] | None = None
    calibration_id: str | None = None
    table_id: str | None = None


class Tool(ResponseModel):
    """A tool."""

    id: str
    device_id: str
    title: str
    markers_mm: tuple[tuple[float, float, float], ...]
    strobe_markers: tuple[int, ...] | None
    tip: Tip
    reference_id: str | None
    limits: ToolLimits
    origin: Origin
    note: str
    created_at: datetime
    updated_at: datetime


class Pose(ResponseModel):
    """The newest pose of a tool, or why there is none."""

    tool_id: str
    device_id: str
    frame_id: str
    status: str
    reason: str | None
    exposure_ns: int | None
    sequence: int | None
    age_s: float | None
    calibration_id: str | None
    table_id: str | None
    translation_mm: tuple[float, float, float] | None
    rotation: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    quaternion_wxyz: tuple[float, float, float, float] | None
    matrix: tuple[tuple[float, float, float, float], ...] | None
    covariance: (
        tuple[
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
        ]
        | None
    )
    tip_mm: tuple[float, float, float] | None
    tip_covariance_mm2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    residual_sigma: float | None
    markers_used: int
    readings_used: int
    detectable_sigma: float | None
    external_tip_mm: float | None
    external_rotation_rad: float | None


class NewToolCalibration(ResponseModel):
    """Request of a pivot or spin calibration from live poses."""

    duration_s: float = 10.0
    poses: int = 500
    min_swing_deg: float | None = None
    relative: bool = True
    apply: bool = True


class ToolCalibration(ResponseModel):
    """A pivot or spin calibration and its results."""

    id: str
    tool_id: str
    device_id: str
    kind: str
    applied: bool
    poses: int
    outliers: int
    tip_mm: tuple[float, float, float] | None
    tip_covariance_mm2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    axis: tuple[float, float, float] | None
    point_mm: tuple[float, float, float] | None
    rms_mm: float
    residual_sigma: float | None
    smallest_rotation_deg: float
    calibration_id: str | None = None
    table_id: str | None = None
    request: NewToolCalibration
    created_at: datetime


class MeasuredPoint(ResponseModel):
    """A point that a tip was held on; it is not kept."""

    name: str | None
    tool_id: str
    device_id: str
    frame_id: str
    position_mm: tuple[float, float, float]
    covariance_mm2: tuple[
        tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
    ]
    sigma_mm: float
    drift_mm: float
    frames: int
    first_ns: int
    last_ns: int
    tool_calibration_id: str | None
    calibration_id: str
    table_id: str | None


class FiducialError(ResponseModel):
    """Residual of one fiducial."""

    name: str
    residual_mm: tuple[float, float, float]
    error_mm: float


class FrameMarker(ResponseModel):
    """One of the three markers that make a frame."""

    name: str
    measured_mm: tuple[float, float, float]
    covariance_mm2: tuple[
        tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
    ]
    frames: int | None


class AlternativeSolution(ResponseModel):
    """Another place where the points lie on the surface about as well."""

    matrix: tuple[tuple[float, float, float, float], ...]
    rms_mm: float


class SurfaceFit(ResponseModel):
    """Residuals of points on a surface, and how well it constrains the registration."""

    rms_mm: float
    iterations: int
    points: int
    distance_mm: tuple[float, ...]
    used: tuple[bool, ...]
    stiffness_ratio: float
    weakest_motion: str
    rotation_deg: float
    shift_mm: float
    alternative: AlternativeSolution | None


class TargetError(ResponseModel):
    """Expected error at a target."""

    name: str
    error_mm: float
    covariance_mm2: tuple[
        tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
    ]


class RegistrationTarget(ResponseModel):
    """A place in the frame at which the error is asked for."""

    name: str
    frame_mm: tuple[float, float, float]


class Fiducial(ResponseModel):
    """A point whose place is known in the frame and was measured."""

    name: str
    frame_mm: tuple[float, float, float]
    measured_mm: tuple[float, float, float]
    measured_covariance_mm2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    ) = None


class NewPairedPoints(ResponseModel):
    """Points whose places are known in the frame, and were measured."""

    id: str
    device_id: str
    targets: tuple[RegistrationTarget, ...] | None = None
    note: str = ""
    reference_id: str | None = None
    kind: Literal["paired-points"] = "paired-points"
    fiducials: tuple[Fiducial, ...]
    frame_sigma_mm: float | None = None
    measured_sigma_mm: float | None = None


class NewThreeMarkers(ResponseModel):
    """Three markers that make a frame: M1 its origin, M2 on its x axis, M3 at a positive y."""

    id: str
    device_id: str
    targets: tuple[RegistrationTarget, ...] | None = None
    note: str = ""
    reference_id: str | None = None
    kind: Literal["three-markers"]
    measured_mm: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    ) = None
    measured_covariance_mm2: (
        tuple[
            tuple[
                tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
            ],
            tuple[
                tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
            ],
            tuple[
                tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
            ],
        ]
        | None
    ) = None
    measured_sigma_mm: float | None = None
    strobe_markers: tuple[int, int, int] | None = None
    duration_s: float = 1.0


class SurfaceSummary(ResponseModel):
    """Summary of a given surface, by which another can be compared; the surface is not kept."""

    kind: str
    vertices: int
    triangles: int | None
    sha256: str


class StoredSurfaceRequest(ResponseModel):
    """Stored request of a registration by a surface, with a summary of the surface."""

    id: str
    device_id: str
    targets: tuple[RegistrationTarget, ...] | None = None
    note: str = ""
    kind: Literal["surface"]
    parent_id: str
    points_mm: tuple[tuple[float, float, float], ...]
    trim: float = 0.1
    max_rms_mm: float = 5.0
    initial_rotation_tolerance_deg: float = 5.0
    initial_shift_tolerance_mm: float = 5.0
    surface: SurfaceSummary


class Registration(ResponseModel):
    """A registration: a named frame in which poses can be asked for."""

    id: str
    kind: str
    device_id: str
    reference_id: str | None
    parent_id: str | None = None
    parent_created_at: datetime | None = None
    calibration_id: str | None = None
    table_id: str | None = None
    matrix: tuple[tuple[float, float, float, float], ...]
    covariance: tuple[
        tuple[float, float, float, float, float, float],
        tuple[float, float, float, float, float, float],
        tuple[float, float, float, float, float, float],
        tuple[float, float, float, float, float, float],
        tuple[float, float, float, float, float, float],
        tuple[float, float, float, float, float, float],
    ]
    fre_mm: float | None = None
    fle_mm: float | None = None
    residual_sigma: float | None = None
    fiducials: tuple[FiducialError, ...] | None = None
    markers: tuple[FrameMarker, ...] | None = None
    surface: SurfaceFit | None = None
    targets: tuple[TargetError, ...]
    warnings: tuple[str, ...]
    request: NewPairedPoints | NewThreeMarkers | StoredSurfaceRequest
    note: str
    created_at: datetime


class FrameState(ResponseModel):
    """A frame, and whether it is connected with another one now."""

    id: str
    kind: str
    to_frame_id: str | None
    connected: bool
    status: str
    reason: str | None
    root_frame_id: str


class FrameList(ResponseModel):
    """A device's frames at its newest frame."""

    device_id: str
    exposure_ns: int | None
    sequence: int | None
    age_s: float | None
    calibration_id: str | None
    table_id: str | None
    frames: tuple[FrameState, ...]


class FrameTransform(ResponseModel):
    """The transform from one frame to another at a device's newest frame, or why there is
    none.
    """

    device_id: str
    frame_id: str
    to_frame_id: str
    status: str
    reason: str | None
    path_frame_ids: tuple[str, ...] | None
    exposure_ns: int | None
    sequence: int | None
    age_s: float | None
    calibration_id: str | None
    table_id: str | None
    matrix: tuple[tuple[float, float, float, float], ...] | None
    translation_mm: tuple[float, float, float] | None
    rotation: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    quaternion_wxyz: tuple[float, float, float, float] | None
    covariance: (
        tuple[
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
        ]
        | None
    )


class ToolWatch(ResponseModel):
    """A tool that is fixed to the patient, by its pose."""

    kind: Literal["tool"]
    tool_id: str
    target_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axes: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    ) = None


class StrobedMarkersWatch(ResponseModel):
    """Strobed markers on the patient, each by its number."""

    kind: Literal["strobed-markers"]
    markers: tuple[int, ...]
    min_markers: int | None = None


class SimultaneousMarkersWatch(ResponseModel):
    """Markers on the patient that are lit together, each near its place."""

    kind: Literal["simultaneous-markers"]
    markers: int
    min_markers: int | None = None
    search_radius_mm: float = 30.0
    observed_as: str = "points"


class Limits(ResponseModel):
    """Largest motion from the reference; at least one of the first three is needed."""

    shift_mm: float | None = None
    axis_mm: tuple[float, float, float] | None = None
    rotation_rad: float | None = None
    probability: float = 0.05
    release: float = 0.8


class Rules(ResponseModel):
    """Timing rules of the begin and end of a beam hold."""

    max_gap_s: float = 0.1
    settle_s: float = 0.5
    latched: bool = False


class Reference(ResponseModel):
    """Reference of a beam hold: the pose or the positions at set-up."""

    id: str
    kind: str
    calibration_id: str | None
    table_id: str | None
    rotation: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    )
    translation_mm: tuple[float, float, float] | None
    covariance: (
        tuple[
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
            tuple[float, float, float, float, float, float],
        ]
        | None
    )
    positions_mm: tuple[tuple[float, float, float], ...] | None
    covariances_mm2: (
        tuple[
            tuple[
                tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
            ],
            ...,
        ]
        | None
    )
    frames: int | None
    scatter_mm: float | None
    set_at: datetime


class BeamHold(ResponseModel):
    """A beam hold."""

    id: str
    device_id: str
    title: str
    watch: ToolWatch | StrobedMarkersWatch | SimultaneousMarkersWatch
    limits: Limits
    rules: Rules
    reference: Reference | None
    note: str
    created_at: datetime
    updated_at: datetime


class BeamHoldStatus(ResponseModel):
    """State of a beam hold, with its cause."""

    hold_id: str
    device_id: str
    held: bool
    cause: str
    reason: str | None
    since_ns: int
    exposure_ns: int | None
    sequence: int | None
    shift_mm: tuple[float, float, float] | None
    rotation_rad: tuple[float, float, float] | None
    probability: float | None


class PixelNoise(ResponseModel):
    """Conversion and noise of the sensor that the scans come from."""

    electrons_per_count: float
    read_noise_electrons: float
    offset_counts: float = 0.0
    full_scale_counts: int = 65535


class Stage(ResponseModel):
    """A line on its way."""

    name: str
    unit: str
    shift_px: float
    values: tuple[float, ...]


class LineScan(ResponseModel):
    """Peaks of one line scan."""

    index: int
    sensor: str | None = None
    background_counts: float
    noise_counts: float
    measured_noise_counts: float
    saturated_pixels: int
    limit_counts: float | None
    limit_sigma: float | None
    further_peaks: int | None
    peaks: tuple[LinePeak, ...]
    covariance_px2: tuple[tuple[float, ...], ...] | None
    windows: tuple[FitWindow, ...] | None
    stages: tuple[Stage, ...] | None


class LineScans(ResponseModel):
    """Peaks of line scans."""

    method: str
    noise: PixelNoise
    assumed: tuple[str, ...]
    scans: tuple[LineScan, ...]


class DeviceProfileSummary(ResponseModel):
    """A device in a few words."""

    id: str
    title: str
    year: int | None
    sensor_count: int
    pixel_count: int
    max_markers: int


class SensorProfile(ResponseModel):
    """Position and orientation of one line sensor."""

    name: str
    position_mm: tuple[float, float, float]
    aim_mm: tuple[float, float, float]
    measured_direction: tuple[float, float, float]
    optics: str


class PixelRow(ResponseModel):
    """A row of pixels, centred on the origin of the sensor's frame."""

    count: int
    pitch_um: float
    height_um: float


class DetectorProfile(ResponseModel):
    """Detector parameters of a profile."""

    bits: int
    full_well_electrons: float
    read_noise_electrons: float
    dark_current_electrons_per_s: float
    electrons_per_count: float
    offset_counts: float
    quantum_efficiency: float
    response_nonuniformity: float
    dark_nonuniformity: float
    blooming: float
    ambient_electrons_per_s: float
    offset_nonuniformity_counts: float = 0.0


class LedMarkers(ResponseModel):
    """Active markers."""

    radiant_intensity_w_per_sr: float
    wavelength_nm: float
    spectral_width_nm: float
    half_angle_rad: float
    emitter_width_mm: float
    max_markers: int
    illumination: str


class RetroMarkers(ResponseModel):
    """Retro-reflective markers with one illuminator; all are lit at once."""

    illuminator_intensity_w_per_sr: float
    illuminator_position_mm: tuple[float, float, float]
    wavelength_nm: float
    spectral_width_nm: float
    retroreflection_per_sr: float
    observation_half_angle_rad: float
    half_angle_rad: float
    diameter_mm: float
    max_markers: int


class ProfileSectionsRates(ResponseModel):
    """Line rate and exposure time."""

    line_rate_hz: float
    exposure_s: float


class Volume(ResponseModel):
    """Working volume, a box along the axes of the world."""

    centre_mm: tuple[float, float, float]
    size_mm: tuple[float, float, float]


class PublishedFigure(ResponseModel):
    """One published figure of a device."""

    quantity: str
    axis: str
    value_mm: float
    source: str
    distance_mm: float | None = None
    note: str = ""


class ErrorSources(ResponseModel):
    """Systematic error sources of a device; None: the typical value, called assumed."""

    pixels: str | None = None
    flat_field_residual: float | None = None
    reading_step_px: float | None = None
    control_points: int | None = None
    control_position_sigma_mm: float | None = None
    distortion: str | None = None
    uncorrected_distortion_px: tuple[float, ...] | None = None
    terms_residual_px: float | None = None
    map_residual_px: float | None = None
    optical_centre_depth_mm: float | None = None
    marker_tilt_rad: float | None = None
    expansion_per_k: float | None = None
    focus_expansion_per_k: float | None = None
    temperature_change_k: float | None = None
    bar_gradient_k: float | None = None
    bar_depth_mm: float | None = None
    timing_s: float | None = None
    speed_mm_per_s: float | None = None


class DeviceProfileDocument(ResponseModel):
    """A device as published; lengths in mm, angles in rad, times in s."""

    id: str
    title: str
    year: int | None
    sensor_count: int
    pixel_count: int
    max_markers: int
    sources: tuple[str, ...]
    sensors: tuple[SensorProfile, ...]
    pixels: PixelRow
    detector: DetectorProfile
    markers: LedMarkers | RetroMarkers
    rates: ProfileSectionsRates
    volume: Volume
    published: tuple[PublishedFigure, ...]
    error_sources: ErrorSources
    notes: tuple[str, ...]
    assumed: dict[str, str]
    toml: str
    content_hash: str


class Box(ResponseModel):
    """A working volume: a box along the world's axes."""

    centre_mm: tuple[float, float, float]
    size_mm: tuple[float, float, float]


class PlannedSensor(ResponseModel):
    """One sensor: medians over the points that it sees."""

    name: str
    position_mm: tuple[float, float, float]
    scan_electrons: float | None
    peak_electrons: float | None
    saturated: float
    bound_px: float | None
    centroid_px: float | None
    fixed_pattern_px: float | None
    misfit_px: float
    principal_distance_px: float


class AxisSummary(ResponseModel):
    """Summary of one quantity along X, Y and Z over the points that can be reconstructed [mm]."""

    best: tuple[float, float, float] | None
    median: tuple[float, float, float] | None
    worst: tuple[float, float, float] | None
    centre: tuple[float, float, float] | None


class BudgetContribution(ResponseModel):
    """One source of uncertainty, summarised over the volume."""

    name: str
    kind: str
    counted: bool
    assumed: bool
    inputs: tuple[str, ...]
    sigma: AxisSummary
    rms_mm: float
    by_distance_mm: tuple[float, ...]
    share: float


class BudgetInput(ResponseModel):
    """One value that an accuracy budget rests on."""

    name: str
    value: float | str | tuple[float, ...]
    unit: str
    assumed: bool
    source: str


class AccuracyBudget(ResponseModel):
    """Uncertainty budget of a point's position (GUM, JCGM 100): every source, and their sum."""

    contributions: tuple[BudgetContribution, ...]
    dominant: str
    random: AxisSummary
    systematic: AxisSummary
    total: AxisSummary
    total_rms_mm: float
    distances_mm: tuple[float, ...]
    total_by_distance_mm: tuple[float, ...]
    inputs: tuple[BudgetInput, ...]


class Coverage(ResponseModel):
    """Shares of a volume that sensors see."""

    by_count: tuple[float, ...]
    by_sensor: tuple[float, ...]
    all_sensors: float
    three_or_more: float


class DataRatesRates(ResponseModel):
    """Rates of a device with N markers."""

    markers: int
    illumination: str
    line_rate_hz: float
    marker_rate_hz: float
    points_per_s: float
    raw_pixels_per_s: float
    raw_bytes_per_s: float
    reduced_bytes_per_s: float
    reduction: float


class GhostCount(ResponseModel):
    """Expected number of wrong combinations that look like markers."""

    markers: int
    candidates: int
    expected: float
    standard_error: float


class PlannedPoint(ResponseModel):
    """One point of the grid."""

    position_mm: tuple[float, float, float]
    sensors: int
    saturated: int
    sd_mm: tuple[float, float, float] | None
    centroid_sd_mm: tuple[float, float, float] | None
    dilution_mm: tuple[float, float, float] | None
    fixed_pattern_mm: tuple[float, float, float] | None
    distortion_mm: tuple[float, float, float] | None
    uncertainty_mm: tuple[float, float, float] | None


class Plan(ResponseModel):
    """Predicted performance of a device, from its profile alone."""

    profile_id: str
    title: str
    volume: Box
    grid: tuple[int, int, int]
    sensors: tuple[PlannedSensor, ...]
    noise: AxisSummary
    centroid: AxisSummary
    dilution: AxisSummary
    fixed_pattern: AxisSummary
    distortion: AxisSummary
    budget: AccuracyBudget | None
    coverage: Coverage
    rates: tuple[DataRatesRates, ...]
    planar_intersections: tuple[int, ...]
    ghosts: tuple[GhostCount, ...]
    points: tuple[PlannedPoint, ...]
    notes: tuple[str, ...]


class StreamClient(ResponseModel):
    """A client of a device's stream."""

    id: str
    device_id: str
    client: str
    opened_at: datetime
    content: tuple[str, ...]
    encoding: str
    mode: str
    rate_hz: float | None
    messages_waiting: int
    messages_missed: int


class ApiKey(ResponseModel):
    """A key that was given out, without its secret, which is kept nowhere."""

    id: str
    name: str
    scopes: tuple[str, ...]
    state: str
    created_by: str
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    last_used_at: datetime | None


class CreatedApiKey(ResponseModel):
    """A key that was just made."""

    id: str
    name: str
    scopes: tuple[str, ...]
    state: str
    created_by: str
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    last_used_at: datetime | None
    key: str


class RequestPrincipal(ResponseModel):
    """Principal of the request, with its scopes."""

    kind: str
    id: str
    name: str
    scopes: tuple[str, ...]
    expires_at: datetime | None


class Webhook(ResponseModel):
    """A webhook, without its secret."""

    id: str
    title: str
    url: str
    event_types: tuple[str, ...]
    enabled: bool
    created_at: datetime
    updated_at: datetime


class CreatedWebhook(ResponseModel):
    """A webhook that was just made."""

    id: str
    title: str
    url: str
    event_types: tuple[str, ...]
    enabled: bool
    created_at: datetime
    updated_at: datetime
    secret: str


class WebhookState(ResponseModel):
    """Deliveries of this server to a webhook, since its start."""

    webhook_id: str
    state: str
    events_waiting: int
    events_delivered: int
    events_failed: int
    events_dropped: int
    attempted_at: datetime | None
    reason: str | None


class Actor(ResponseModel):
    """Key, token or local program that acted."""

    kind: str
    id: str
    name: str


class AuditEntry(ResponseModel):
    """One change, or an attempt that was refused."""

    id: int
    created_at: datetime
    actor: Actor
    operation: str
    outcome: str
    object_kind: str
    object_id: str | None
    before: dict[str, Any] | None
    after: dict[str, Any] | None
    detail: str | None
    request_id: str | None
    address: str | None


class LogRecord(ResponseModel):
    """A line of the server's log."""

    id: int
    created_at: datetime
    level: str
    logger: str
    message: str
    request_id: str | None
    device_id: str | None
    traceback: str | None


class Setting(ResponseModel):
    """A setting of the server, as it is in force."""

    name: str
    value: Any
    is_default: bool
    description: str


class Station(ResponseModel):
    """A process that devices belong to."""

    name: str | None
    state: str
    reason: str | None
    changed_at: datetime | None
    host: str | None
    devices: int
    restarts: int
    messages_missed: int
    memory_bytes: int
    cpu_s: float
    round_trip_ms: float | None


class Backup(ResponseModel):
    """A backup of database, recordings and profiles."""

    id: str
    created_at: datetime
    path: str
    database_bytes: int


class ErrorStatistics(ResponseModel):
    """Summary of N errors [mm], with the values that ASTM F2554 requires."""

    count: int
    mean: float
    standard_deviation: float
    rms: float
    percentile_95: float
    largest: float


class SinglePoint(ResponseModel):
    """Precision of a stationary marker."""

    position_mm: tuple[float, float, float]
    scatter: ErrorStatistics
    axes_mm: tuple[float, float, float]
    stated_mm: float
    drift_mm_per_min: float
    drift_sigma_mm_per_min: float
    bias: float | None


class PointToPoint(ResponseModel):
    """Accuracy of a measured distance."""

    reference_mm: float
    errors: ErrorStatistics
    mean_sigma_mm: float
    normalised_square: float
    extent_mm: tuple[float, float, float]


class QualityCheck(ResponseModel):
    """Result of a quality check."""

    id: str
    device_id: str
    kind: str
    calibration_id: str
    table_id: str | None
    asked: dict[str, Any]
    result: SinglePoint | PointToPoint
    passed: bool | None
    points: int
    left_out: int
    temperature_c: float | None
    note: str
    created_at: datetime


class ReferenceMarker(ResponseModel):
    """A strobed marker that is fixed to where the device stands."""

    marker: int


class WatchSettings(ResponseModel):
    """Settings of watching a device's drift."""

    interval_s: float = 600.0
    reference: ReferenceMarker | None = None


class ChartPoint(ResponseModel):
    """One value of a control chart."""

    measured_at: datetime
    value: float
    average: float
    signal: str


class Chart(ResponseModel):
    """A control chart: values over time and the limits that they keep while nothing changes."""

    series: str
    meaning: str
    unit: str
    ready: bool
    baseline: int
    centre: float | None
    lower: float | None
    upper: float | None
    points: tuple[ChartPoint, ...]


class Quality(ResponseModel):
    """Quality of a device with its active calibration, and the recommended action."""

    device_id: str
    calibration_id: str | None
    table_id: str | None
    watch: WatchSettings
    recommendation: str
    reasons: tuple[str, ...]
    charts: tuple[Chart, ...]


class WatchSample(ResponseModel):
    """Statistics of a running device over one interval."""

    device_id: str
    calibration_id: str
    table_id: str | None
    measured_at: datetime
    duration_s: float
    points: int
    residual_sigma: float | None
    inconsistent: int
    reference_mm: tuple[float, float, float] | None
    reference_scatter_mm: float | None
    temperature_c: float | None


class Landing(ResponseModel):
    """Entry point: links to the documentation and the resources."""

    name: str
    version: str
    links: dict[str, str]


class Health(ResponseModel):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Readiness(ResponseModel):
    """Requests can be served."""

    status: Literal["ok"] = "ok"
    limits: tuple[str, ...]
    failed_devices: int
    failed: tuple[str, ...] | None


class ProblemType(ResponseModel):
    """A problem type: its code, status and meaning."""

    code: str
    type: str
    status: int
    title: str
    meaning: str
