"""Members of the bodies of requests; mypy and editors check the client's methods by them."""
# Made from the OpenAPI document by docs/generators/client_code.py; edit nothing here.

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, Literal, NotRequired, TypedDict


class CalibrationTarget(TypedDict):
    """The thesis's pyramidal calibration frame with 19 markers, at rest (Figure 5.8)."""

    kind: Literal["calibration-frame"]
    centre_mm: NotRequired[Sequence[float]]
    scale: NotRequired[float]


class StillPoints(TypedDict):
    """Markers at rest at given points."""

    points_mm: Sequence[Sequence[float]]
    kind: Literal["still-points"]


class ShiftedPoints(TypedDict):
    """Markers on somebody who rests, and moves aside for the last part of every period."""

    points_mm: Sequence[Sequence[float]]
    shift_mm: NotRequired[Sequence[float]]
    period_s: NotRequired[float]
    away: NotRequired[float]
    moving_s: NotRequired[float]
    kind: Literal["shifted-points"]


class RotatingBar(TypedDict):
    """A bar that turns at constant speed about its middle, a marker at each end (section
    6.1.2).
    """

    kind: Literal["rotating-bar"]
    length_mm: NotRequired[float]
    period_s: NotRequired[float]
    centre_mm: NotRequired[Sequence[float]]
    plane_normal: NotRequired[Sequence[float]]


class MovingTool(TypedDict):
    """A rigid tool that is moved smoothly in all six degrees of freedom."""

    markers_mm: Sequence[Sequence[float]]
    centre_mm: NotRequired[Sequence[float]]
    swing_mm: NotRequired[Sequence[float]]
    turn_rad: NotRequired[Sequence[float]]
    rest_rad: NotRequired[Sequence[float]]
    held_mm: NotRequired[Sequence[float]]
    period_s: NotRequired[float]
    phase: NotRequired[float]


class MovingTools(TypedDict):
    """Rigid tools in motion; their markers are numbered tool by tool, in order."""

    tools: Sequence[MovingTool]
    moving: NotRequired[bool]
    kind: Literal["moving-tools"]


class WavedWand(TypedDict):
    """A wand of two markers that is waved through a volume in all directions, for calibration."""

    kind: Literal["waved-wand"]
    length_mm: NotRequired[float]
    centre_mm: NotRequired[Sequence[float]]
    swing_mm: NotRequired[Sequence[float]]
    period_s: NotRequired[float]


class EvenLight(TypedDict):
    """Even light on all pixels and no marker, for radiometric calibration."""

    electrons: NotRequired[float]
    kind: Literal["even-light"]


class StrobeSchedule(TypedDict):
    """A cyclic sequence of slots, one exposure each; each slot lights one marker, or all."""

    slots: Sequence[int | None]


class BlinkSchedule(TypedDict):
    """Cyclic code words of the markers, one bit per exposure, each with its own phase."""

    words: Sequence[str]
    low: NotRequired[float]
    phases: NotRequired[Sequence[int] | None]


class PixelDefects(TypedDict):
    """Differences of the pixels and bad pixels, drawn for each sensor from a seed."""

    response_nonuniformity: NotRequired[float]
    offset_nonuniformity_counts: NotRequired[float]
    dead_pixels: NotRequired[int]
    hot_pixels: NotRequired[int]
    stuck_pixels: NotRequired[int]
    hot_electrons: NotRequired[float]
    seed: NotRequired[int]


class BarPlacement(TypedDict):
    """Place and rotation of a bar in a hall, whose time is the host's."""

    position_mm: NotRequired[Sequence[float]]
    rotation_rad: NotRequired[Sequence[float]]
    delay_ms: NotRequired[float]


class SimulationSettings(TypedDict):
    """What the simulated device shows, and how its sensors see it."""

    scene: NotRequired[
        CalibrationTarget
        | StillPoints
        | ShiftedPoints
        | RotatingBar
        | MovingTools
        | WavedWand
        | EvenLight
    ]
    frame_rate_hz: NotRequired[float]
    illumination: NotRequired[Literal["strobed", "simultaneous"]]
    strobe: NotRequired[StrobeSchedule | None]
    blink: NotRequired[BlinkSchedule | None]
    spot_sigma_px: NotRequired[float]
    signal_electrons: NotRequired[float]
    distance_falloff: NotRequired[bool]
    ambient_electrons: NotRequired[float]
    read_noise_electrons: NotRequired[float]
    full_well_electrons: NotRequired[float]
    electrons_per_count: NotRequired[float]
    offset_counts: NotRequired[float]
    bits: NotRequired[int]
    pixels: NotRequired[PixelDefects | None]
    seed: NotRequired[int]
    peaks: NotRequired[Literal["fit", "centroid"]]
    placement: NotRequired[BarPlacement | None]
    duration_s: NotRequired[float | None]
    realtime: NotRequired[bool]


class SimulatedSource(TypedDict):
    """Line scans from the simulator."""

    kind: Literal["simulated"]
    settings: NotRequired[SimulationSettings]


class ProfileSettings(TypedDict):
    """What a profile's device shows, and how it is simulated."""

    scene: NotRequired[
        CalibrationTarget
        | StillPoints
        | ShiftedPoints
        | RotatingBar
        | MovingTools
        | WavedWand
        | EvenLight
        | None
    ]
    optics: NotRequired[Literal["tabulated", "exact"]]
    frame_rate_hz: NotRequired[float | None]
    illumination: NotRequired[Literal["strobed", "simultaneous"] | None]
    seed: NotRequired[int]
    pattern_seed: NotRequired[int]
    peaks: NotRequired[Literal["fit", "centroid"]]
    duration_s: NotRequired[float | None]
    realtime: NotRequired[bool]


class ProfileSource(TypedDict):
    """Line scans of a device simulated from its profile: its optics, light and detector."""

    kind: Literal["profile"]
    profile_id: str
    settings: NotRequired[ProfileSettings]


class ReplaySource(TypedDict):
    """Line scans from a recording in the data directory's folder ``recordings``."""

    kind: Literal["replay"]
    recording_id: str
    speed: NotRequired[float | None]


class SerialSettings(TypedDict):
    """Port of a device, and settings sent to it."""

    url: str
    baudrate: NotRequired[int]
    silent_after_s: NotRequired[float]
    frame_rate_hz: NotRequired[float | None]
    exposure_us: NotRequired[float | None]
    strobe: NotRequired[StrobeSchedule | None]
    peaks: NotRequired[Literal["fit", "centroid"]]


class SerialSource(TypedDict):
    """A device on a serial port with the line-scan protocol (docs/reference/serial-
    protocol.md).
    """

    kind: Literal["serial"]
    settings: SerialSettings


class Tcd1304Board(TypedDict):
    """One board: the sensor's name, and where its serial port is."""

    name: str
    port: str


class Tcd1304Settings(TypedDict):
    """The boards, and how their lines are taken."""

    boards: Sequence[Tcd1304Board]
    exposure_us: NotRequired[float]
    averages: NotRequired[int]
    clock_hz: NotRequired[int]
    baud_rate: NotRequired[int]
    gap_ms: NotRequired[float]
    saturated_at: NotRequired[int]
    electrons_per_count: NotRequired[float]
    read_noise_electrons: NotRequired[float]
    peaks: NotRequired[Literal["fit", "centroid"]]


class Tcd1304Source(TypedDict):
    """Open TCD1304 boards, each at a serial port (docs/how-to/tcd1304.md)."""

    kind: Literal["tcd1304"]
    settings: Tcd1304Settings


class GenicamCamera(TypedDict):
    """One camera: the sensor's name, and its identifier or network address."""

    name: str
    camera: str


class Feature(TypedDict):
    """A feature of the camera by its GenICam name, and its value."""

    name: str
    value: bool | int | float | str


class GenicamSettings(TypedDict):
    """The cameras, and how they are set."""

    cameras: Sequence[GenicamCamera]
    pitch_um: float
    pixel_format: NotRequired[
        Literal[
            "Mono8",
            "Mono10",
            "Mono12",
            "Mono14",
            "Mono16",
            "Mono10p",
            "Mono12p",
            "Mono10Packed",
            "Mono12Packed",
        ]
    ]
    width: NotRequired[int | None]
    offset_x: NotRequired[int]
    lines_per_buffer: NotRequired[int]
    exposure_us: NotRequired[float | None]
    line_rate_hz: NotRequired[float | None]
    features: NotRequired[Sequence[Feature]]
    match_us: NotRequired[float]
    electrons_per_count: NotRequired[float]
    read_noise_electrons: NotRequired[float]
    offset_counts: NotRequired[float]
    peaks: NotRequired[Literal["fit", "centroid"]]


class GenicamSource(TypedDict):
    """GenICam line-scan cameras, GigE Vision or USB3 Vision (docs/how-to/genicam.md)."""

    kind: Literal["genicam"]
    settings: GenicamSettings


class FusionSettings(TypedDict):
    """How the frames of several bars are put together."""

    max_wait_ms: NotRequired[float]
    clock_uncertainty_us: NotRequired[float]


class FusionSource(TypedDict):
    """The peaks of two bars or more that see one volume (docs/how-to/fusion.md)."""

    kind: Literal["fusion"]
    bars: Sequence[str]
    settings: NotRequired[FusionSettings]


class Sensor(TypedDict):
    """One line sensor: name, number of pixels, pixel pitch [um]."""

    name: str
    pixels: int
    pitch_um: float


class ExternalSource(TypedDict):
    """No driver: a program of yours reads the sensors and posts peak positions."""

    kind: Literal["external"]
    sensors: Sequence[Sensor]


class Blinking(TypedDict):
    """The codes that markers show, one bit an exposure, again and again."""

    words: Sequence[str]
    off_level: NotRequired[float]
    miss_probability: NotRequired[float]


class Tracking(TypedDict):
    """Settings of tracking markers and tools of a running device; all have defaults."""

    tracks: NotRequired[Literal["never", "with-tools", "always"]]
    motion: NotRequired[Literal["velocity", "acceleration", "interacting"]]
    acceleration_psd: NotRequired[float]
    jerk_psd: NotRequired[float]
    coast_s: NotRequired[float]
    blinking: NotRequired[Blinking | None]
    tool_acceleration_mm_s2: NotRequired[float]
    tool_angular_acceleration_rad_s2: NotRequired[float]
    tool_coast_s: NotRequired[float]
    tool_tip_sd_mm: NotRequired[float]
    tool_max_detectable_sigma: NotRequired[float | None]
    volume_mm: NotRequired[Sequence[Sequence[float]] | None]


class NewDevice(TypedDict):
    """A device to create."""

    id: str
    title: str
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
    station: NotRequired[str | None]
    autostart: NotRequired[bool]
    tracking: NotRequired[Tracking]


class DeviceChange(TypedDict):
    """Changes of a device; a field left out stays as it is, of ``tracking`` too."""

    title: NotRequired[str]
    station: NotRequired[str | None]
    source: NotRequired[
        SimulatedSource
        | ProfileSource
        | ReplaySource
        | SerialSource
        | Tcd1304Source
        | GenicamSource
        | FusionSource
        | ExternalSource
    ]
    autostart: NotRequired[bool]
    tracking: NotRequired[Tracking]


class Reading(TypedDict):
    """One reading with its standard deviation."""

    position_px: float
    sigma_px: float


class ControlPoint(TypedDict):
    """A point of known position and what the sensors read of it."""

    name: str
    position_mm: Sequence[float]
    readings: Mapping[str, float | Reading]


class NewCalibration(TypedDict):
    """Control points from which a device is calibrated."""

    distortion: NotRequired[
        Literal[
            "none",
            "auto",
            "odd-powers",
            "all-powers",
            "symmetric-3",
            "symmetric-5",
            "symmetric-7",
            "all-3",
            "all-5",
            "factory-19",
        ]
        | Sequence[Sequence[int]]
    ]
    position_sigma_mm: NotRequired[float | None]
    loss: NotRequired[Literal["linear", "robust"]]
    labels: NotRequired[Literal["off", "report", "exclude", "repair"]]
    id: NotRequired[str | None]
    device_id: str
    points: Sequence[ControlPoint]
    note: NotRequired[str]


class NewNominalCalibration(TypedDict):
    """The device whose profile gives a calibration."""

    id: NotRequired[str | None]
    device_id: str


class NewCalibrationRun(TypedDict):
    """Control points, or a capture session that holds them, from which a device is calibrated."""

    distortion: NotRequired[
        Literal[
            "none",
            "auto",
            "odd-powers",
            "all-powers",
            "symmetric-3",
            "symmetric-5",
            "symmetric-7",
            "all-3",
            "all-5",
            "factory-19",
        ]
        | Sequence[Sequence[int]]
    ]
    position_sigma_mm: NotRequired[float | None]
    loss: NotRequired[Literal["linear", "robust"]]
    labels: NotRequired[Literal["off", "report", "exclude", "repair"]]
    points: NotRequired[Sequence[ControlPoint] | None]
    capture_id: NotRequired[str | None]
    allow_incomplete: NotRequired[bool]
    id: NotRequired[str | None]
    device_id: str
    result_id: NotRequired[str | None]
    note: NotRequired[str]


class NewMappingRun(TypedDict):
    """Measurements at known places, from which a correction table is built for a calibration."""

    points: NotRequired[Sequence[ControlPoint] | None]
    capture_id: NotRequired[str | None]
    allow_incomplete: NotRequired[bool]
    id: NotRequired[str | None]
    device_id: str
    calibration_id: NotRequired[str | None]
    result_id: NotRequired[str | None]
    method: NotRequired[Literal["b-spline", "trilinear", "tricubic"]]
    pitch_mm: NotRequired[Sequence[float] | None]
    penalty_weight: NotRequired[float | None]
    min_neighbours: NotRequired[int]
    position_sigma_mm: NotRequired[float]
    note: NotRequired[str]


class WandTarget(TypedDict):
    """Markers on a line at known places."""

    kind: Literal["wand"]
    position_mm: Sequence[float]
    sigma_mm: NotRequired[float]


class BodyTarget(TypedDict):
    """A rigid body, or calibration frame, of known shape."""

    kind: Literal["rigid-body"]
    marker_mm: Sequence[Sequence[float]]
    sigma_mm: NotRequired[float]


class UnknownTarget(TypedDict):
    """A rigid body of unknown shape, with one known distance for the scale."""

    kind: Literal["unknown-body"]
    markers: int
    first: int
    second: int
    length_mm: float
    sigma_mm: NotRequired[float]


class SelfCalibrationNewRecording(TypedDict):
    """One target, held or waved, and what the sensors read of it."""

    target: WandTarget | BodyTarget | UnknownTarget
    poses: Sequence[Mapping[str, Sequence[float | None]]]
    sigma_px: NotRequired[float | Sequence[Mapping[str, Sequence[float | None]]] | None]


class NewSelfCalibrationRun(TypedDict):
    """Recordings without known coordinates, from which a device is calibrated."""

    id: NotRequired[str | None]
    device_id: str
    start_calibration_id: NotRequired[str | None]
    initial: NotRequired[Literal["start", "readings"]]
    directions_deg: NotRequired[Mapping[str, float] | None]
    distortion: NotRequired[
        Literal[
            "none",
            "auto",
            "odd-powers",
            "all-powers",
            "symmetric-3",
            "symmetric-5",
            "symmetric-7",
            "all-3",
            "all-5",
            "factory-19",
        ]
        | Sequence[Sequence[int]]
    ]
    result_id: NotRequired[str | None]
    recordings: NotRequired[Sequence[SelfCalibrationNewRecording] | None]
    wave_capture_id: NotRequired[str | None]
    datum: NotRequired[Literal["start", "first-pose"]]
    note: NotRequired[str]


class StationaryPoint(TypedDict):
    """A marker that stands still, and what the sensors read of it now."""

    name: str
    position_mm: NotRequired[Sequence[float] | None]
    readings: Mapping[str, float | Reading]


class NewUpdateRun(TypedDict):
    """Still markers read again, or a drift check that holds them, that bring a calibration up
    to date.
    """

    points: NotRequired[Sequence[StationaryPoint] | None]
    capture_id: NotRequired[str | None]
    allow_incomplete: NotRequired[bool]
    against: NotRequired[Literal["positions", "calibration", "capture"]]
    earlier_capture_id: NotRequired[str | None]
    position_sigma_mm: NotRequired[float]
    id: NotRequired[str | None]
    device_id: str
    calibration_id: NotRequired[str | None]
    result_id: NotRequired[str | None]
    drift_check_id: NotRequired[str | None]
    sensors: NotRequired[Sequence[str] | None]
    allowance: NotRequired[Mapping[str, float] | None]
    note: NotRequired[str]


class NewExportRun(TypedDict):
    """A recording of which points, tracks and tool poses are to be written to a file."""

    id: NotRequired[str | None]
    device_id: str
    recording_id: str
    format: Literal["c3d", "trc", "csv", "parquet", "igs.mha"]
    result_id: NotRequired[str | None]
    tool_ids: NotRequired[Sequence[str] | None]
    calibration_id: NotRequired[str | None]
    table_id: NotRequired[str | None]
    predicted: NotRequired[bool]
    points: NotRequired[bool]


class CapturesTarget(TypedDict):
    """A named place at which a marker will be held, or has its own."""

    name: str
    position_mm: Sequence[float]
    marker: NotRequired[int | None]


class CaptureSettings(TypedDict):
    """How each target is captured."""

    frames: NotRequired[int]
    marker: NotRequired[int | None]
    seen_share: NotRequired[float]
    timeout_s: NotRequired[float]
    still_px: NotRequired[float]


class NewCapture(TypedDict):
    """A capture session to begin."""

    id: NotRequired[str | None]
    device_id: str
    note: NotRequired[str]
    targets: Sequence[CapturesTarget]
    recording_id: NotRequired[str | None]
    settings: NotRequired[CaptureSettings]


class WaveSettings(TypedDict):
    """When the taking of poses ends."""

    duration_s: NotRequired[float]
    end_when_enough: NotRequired[bool]


class NewWaveCapture(TypedDict):
    """A session to begin, in which a wand or rigid body is waved in front of a running device."""

    id: NotRequired[str | None]
    device_id: str
    note: NotRequired[str]
    target: WandTarget | BodyTarget | UnknownTarget
    markers: NotRequired[Sequence[int] | None]
    settings: NotRequired[WaveSettings]


class RadiometricCaptureSettings(TypedDict):
    """Settings of capturing dark and flat frames."""

    frames: NotRequired[int]
    levels: NotRequired[int]
    max_level: NotRequired[float]
    timeout_s: NotRequired[float]


class NewRadiometricCapture(TypedDict):
    """A session of dark and flat captures to begin."""

    id: NotRequired[str | None]
    device_id: str
    note: NotRequired[str]
    settings: NotRequired[RadiometricCaptureSettings]


class FromCapture(TypedDict):
    """Estimate from a session of captures."""

    kind: Literal["capture"]
    radiometric_capture_id: str


class FromRecordings(TypedDict):
    """Estimate from recordings in the data directory's folder ``recordings``."""

    kind: Literal["recordings"]
    dark_recording_id: str
    flat_recording_ids: Sequence[str]
    relative_light: NotRequired[Sequence[float] | None]
    temperature_c: NotRequired[float | None]


class FromScans(TypedDict):
    """Estimate from scans that are sent along."""

    kind: Literal["scans"]
    sensors: Mapping[str, Any]
    full_scale_counts: int
    relative_light: NotRequired[Sequence[float] | None]
    temperature_c: NotRequired[float | None]


class FromDocument(TypedDict):
    """A calibration estimated elsewhere, by ``lumiline radiometric-calibration estimate``."""

    kind: Literal["document"]
    sensors: Mapping[str, Any]


class FromBadPixels(TypedDict):
    """Keep the bad pixels that the frames of the running device have shown (its status)."""

    kind: Literal["bad-pixels"]


class FromLines(TypedDict):
    """Measure the shape of lines from a recording of one marker that is moved through the
    field.
    """

    kind: Literal["lines"]
    recording_id: str


class NewRadiometricCalibration(TypedDict):
    """A radiometric calibration to estimate and store."""

    id: NotRequired[str | None]
    device_id: str
    source: FromCapture | FromRecordings | FromScans | FromDocument | FromBadPixels | FromLines
    note: NotRequired[str]


class NewDriftCheck(TypedDict):
    """A drift check to make."""

    points: NotRequired[Sequence[StationaryPoint] | None]
    capture_id: NotRequired[str | None]
    allow_incomplete: NotRequired[bool]
    against: NotRequired[Literal["positions", "calibration", "capture"]]
    earlier_capture_id: NotRequired[str | None]
    position_sigma_mm: NotRequired[float]
    id: NotRequired[str | None]
    note: NotRequired[str]


class ObservedPoint(TypedDict):
    """A point of unknown position and what the sensors read of it."""

    name: str
    readings: Mapping[str, float | Reading]


class NewReconstruction(TypedDict):
    """Readings of which points are computed."""

    id: NotRequired[str | None]
    device_id: str
    calibration_id: NotRequired[str | None]
    points: Sequence[ObservedPoint]


class RecordingsNewRecording(TypedDict):
    """Request of a recording: its content, and when it ends."""

    id: NotRequired[str | None]
    contents: NotRequired[Sequence[Literal["lines", "results"]]]
    max_duration_s: NotRequired[float | None]
    max_size_bytes: NotRequired[int | None]


class ToolLimits(TypedDict):
    """When a pose is not good enough to be used."""

    tip_sd_mm: NotRequired[float | None]


class NewTool(TypedDict):
    """A tool to create, of known geometry."""

    id: str
    device_id: str
    title: str
    tip_mm: NotRequired[Sequence[float] | None]
    reference_id: NotRequired[str | None]
    limits: NotRequired[ToolLimits]
    note: NotRequired[str]
    markers_mm: Sequence[Sequence[float]]
    strobe_markers: NotRequired[Sequence[int] | None]


class NewCapturedTool(TypedDict):
    """A tool to define from what a running device sees of it, held still."""

    id: str
    device_id: str
    title: str
    tip_mm: NotRequired[Sequence[float] | None]
    reference_id: NotRequired[str | None]
    limits: NotRequired[ToolLimits]
    note: NotRequired[str]
    strobe_markers: NotRequired[Sequence[int] | None]
    markers: NotRequired[int | None]
    duration_s: NotRequired[float]


class ToolChange(TypedDict):
    """Changes of a tool; a field left out stays as it is. Its geometry never changes."""

    title: NotRequired[str]
    tip_mm: NotRequired[Sequence[float] | None]
    reference_id: NotRequired[str | None]
    limits: NotRequired[ToolLimits]
    note: NotRequired[str]


class NewToolCalibration(TypedDict):
    """Request of a pivot or spin calibration from live poses."""

    duration_s: NotRequired[float]
    poses: NotRequired[int]
    min_swing_deg: NotRequired[float | None]
    relative: NotRequired[bool]
    apply: NotRequired[bool]


class NewPoint(TypedDict):
    """A point to measure: hold the tip on it."""

    name: NotRequired[str | None]
    frame_id: NotRequired[str | None]
    duration_s: NotRequired[float]
    max_sigma_mm: NotRequired[float]
    max_drift_mm: NotRequired[float]
    timeout_s: NotRequired[float]


class RegistrationTarget(TypedDict):
    """A place in the frame at which the error is asked for."""

    name: str
    frame_mm: Sequence[float]


class Fiducial(TypedDict):
    """A point whose place is known in the frame and was measured."""

    name: str
    frame_mm: Sequence[float]
    measured_mm: Sequence[float]
    measured_covariance_mm2: NotRequired[Sequence[Sequence[float]] | None]


class MeshInput(TypedDict):
    """A surface of triangles."""

    kind: Literal["mesh"]
    vertices_mm: Sequence[Sequence[float]]
    triangles: Sequence[Sequence[int]]


class PointCloudInput(TypedDict):
    """A surface as points of it."""

    kind: Literal["points"]
    points_mm: Sequence[Sequence[float]]
    normals: NotRequired[Sequence[Sequence[float]] | None]


class NewRegistration(TypedDict):
    """A registration to make: a named frame. Without a ``kind`` it is one of paired points."""

    id: str
    device_id: str
    targets: NotRequired[Sequence[RegistrationTarget]]
    note: NotRequired[str]
    reference_id: NotRequired[str | None]
    kind: NotRequired[Literal["paired-points"] | Literal["three-markers"] | Literal["surface"]]
    fiducials: NotRequired[Sequence[Fiducial]]
    frame_sigma_mm: NotRequired[float | None]
    measured_sigma_mm: NotRequired[float | None]
    measured_mm: NotRequired[Sequence[Sequence[float]] | None]
    measured_covariance_mm2: NotRequired[Sequence[Sequence[Sequence[float]]] | None]
    strobe_markers: NotRequired[Sequence[int] | None]
    duration_s: NotRequired[float]
    parent_id: NotRequired[str]
    points_mm: NotRequired[Sequence[Sequence[float]]]
    trim: NotRequired[float]
    max_rms_mm: NotRequired[float]
    initial_rotation_tolerance_deg: NotRequired[float]
    initial_shift_tolerance_mm: NotRequired[float]
    surface: NotRequired[MeshInput | PointCloudInput]


class ToolWatch(TypedDict):
    """A tool that is fixed to the patient, by its pose."""

    kind: Literal["tool"]
    tool_id: str
    target_mm: NotRequired[Sequence[float]]
    axes: NotRequired[Sequence[Sequence[float]] | None]


class StrobedMarkersWatch(TypedDict):
    """Strobed markers on the patient, each by its number."""

    kind: Literal["strobed-markers"]
    markers: Sequence[int]
    min_markers: NotRequired[int | None]


class SimultaneousMarkersWatch(TypedDict):
    """Markers on the patient that are lit together, each near its place."""

    kind: Literal["simultaneous-markers"]
    markers: int
    min_markers: NotRequired[int | None]
    search_radius_mm: NotRequired[float]
    observed_as: NotRequired[Literal["points", "tracks"]]


class Limits(TypedDict):
    """Largest motion from the reference; at least one of the first three is needed."""

    shift_mm: NotRequired[float | None]
    axis_mm: NotRequired[Sequence[float] | None]
    rotation_rad: NotRequired[float | None]
    probability: NotRequired[float]
    release: NotRequired[float]


class Rules(TypedDict):
    """Timing rules of the begin and end of a beam hold."""

    max_gap_s: NotRequired[float]
    settle_s: NotRequired[float]
    latched: NotRequired[bool]


class ReferenceInput(TypedDict):
    """Reference from elsewhere: a tool's pose, or the positions of markers."""

    rotation: NotRequired[Sequence[Sequence[float]] | None]
    translation_mm: NotRequired[Sequence[float] | None]
    covariance: NotRequired[Sequence[Sequence[float]] | None]
    positions_mm: NotRequired[Sequence[Sequence[float]] | None]


class NewBeamHold(TypedDict):
    """A beam hold to create. It holds until it has a reference and all was near it."""

    id: str
    device_id: str
    title: str
    watch: ToolWatch | StrobedMarkersWatch | SimultaneousMarkersWatch
    limits: Limits
    rules: NotRequired[Rules]
    reference: NotRequired[ReferenceInput | None]
    note: NotRequired[str]


class LimitsChange(TypedDict):
    """Limits to change; one left out stays as it is, null takes it away."""

    shift_mm: NotRequired[float | None]
    axis_mm: NotRequired[Sequence[float] | None]
    rotation_rad: NotRequired[float | None]
    probability: NotRequired[float]
    release: NotRequired[float]


class RulesChange(TypedDict):
    """Rules to change; one left out stays as it is."""

    max_gap_s: NotRequired[float]
    settle_s: NotRequired[float]
    latched: NotRequired[bool]


class BeamHoldChange(TypedDict):
    """Changes of a beam hold; members left out stay. Its target never changes."""

    title: NotRequired[str]
    limits: NotRequired[LimitsChange]
    rules: NotRequired[RulesChange]
    note: NotRequired[str]


class NewReference(TypedDict):
    """Request of a reference: measured now, or given."""

    frames: NotRequired[int]
    timeout_s: NotRequired[float]
    max_scatter_mm: NotRequired[float]
    given: NotRequired[ReferenceInput | None]


class CentroidMethod(TypedDict):
    """Threshold and centre of gravity."""

    threshold_fraction: NotRequired[float]
    detection_sigma: NotRequired[float]
    min_width_px: NotRequired[int]
    weighting: NotRequired[Literal["edge-corrected", "above-threshold", "above-background"]]
    max_peaks: NotRequired[int]
    method: Literal["centroid"]


class FitSearch(TypedDict):
    """Search for the candidates of fits."""

    threshold_fraction: NotRequired[float]
    detection_sigma: NotRequired[float]
    min_width_px: NotRequired[int]
    weighting: NotRequired[Literal["edge-corrected", "above-threshold", "above-background"]]
    max_peaks: NotRequired[int]


class Shape(TypedDict):
    """Light of a line in cells finer than pixels, at one place or several along the sensor."""

    light: Sequence[Sequence[float]]
    first_px: float
    step_px: float
    first_node_px: NotRequired[float]
    node_step_px: NotRequired[float]


class FitMethod(TypedDict):
    """Weighted fit of lines integrated over the pixels, overlapping ones together."""

    search: NotRequired[FitSearch]
    width_px: NotRequired[float]
    width_log_sigma: NotRequired[float]
    reach: NotRequired[float]
    background: NotRequired[Literal["surrounding-slope", "level", "slope"]]
    shape_error: NotRequired[float]
    max_joint_peaks: NotRequired[int]
    false_split_rate: NotRequired[float]
    further_peaks: NotRequired[bool]
    widen_misfit: NotRequired[bool]
    method: Literal["fit"]
    shape: NotRequired[Shape | None]


class Median(TypedDict):
    """The median of neighbouring pixels."""

    aperture: int
    compensation: NotRequired[Literal["none", "delay"]]
    kind: Literal["median"]


class Butterworth(TypedDict):
    """A Butterworth low pass."""

    order: int
    cutoff: float
    compensation: NotRequired[Literal["none", "delay", "phase"]]
    kind: Literal["butterworth"]


class Fir(TypedDict):
    """A low pass of finite impulse response."""

    taps: int
    cutoff: float
    compensation: NotRequired[Literal["none", "delay", "phase"]]
    kind: Literal["fir"]


class Polynomial(TypedDict):
    """A polynomial through the pixels between the peaks."""

    degree: NotRequired[int]
    above_sigma: NotRequired[float]
    margin_px: NotRequired[int]
    rounds: NotRequired[int]
    kind: Literal["polynomial"]


class Mask(TypedDict):
    """Mask of the pixels of peaks, for the background."""

    degree: NotRequired[int]
    above_sigma: NotRequired[float]
    margin_px: NotRequired[int]
    rounds: NotRequired[int]


class Bridged(TypedDict):
    """The line with its peaks cut out and the gaps bridged."""

    mask: NotRequired[Mask]
    smoothing: NotRequired[Median | Butterworth | Fir | None]
    kind: Literal["bridged"]


class Areas(TypedDict):
    """Areas whose maximum times sum is large."""

    level_fraction: NotRequired[float]
    keep_fraction: NotRequired[float]


class Valley(TypedDict):
    """Peaks cut apart at the valleys."""

    level_fraction: NotRequired[float]
    min_depth: NotRequired[float]
    kind: Literal["valley-cut"]


class Slope(TypedDict):
    """Peaks cut at the valleys, and the cut slopes continued."""

    level_fraction: NotRequired[float]
    min_depth: NotRequired[float]
    stop_fraction: NotRequired[float]
    kind: Literal["slope-extension"]


class ChainMethod(TypedDict):
    """The chain of the thesis's chapter 4; a step that is null is left out."""

    average: NotRequired[int | None]
    line_filter: NotRequired[Median | Butterworth | Fir | None]
    background: NotRequired[Polynomial | Bridged | None]
    filter_after: NotRequired[Median | Butterworth | Fir | None]
    repeats: NotRequired[int]
    areas: NotRequired[Areas | None]
    separation: NotRequired[Valley | Slope | None]
    level_fraction: NotRequired[float]
    threshold_fraction: NotRequired[float]
    weighting: NotRequired[Literal["edge-corrected", "above-threshold", "above-background"]]
    min_width_px: NotRequired[int]
    max_peaks: NotRequired[int]
    method: Literal["chain"]


class MatchedMethod(TypedDict):
    """Matched filter at a chosen rate of false alarms: faint peaks, to the pixel only."""

    false_alarms_per_line: NotRequired[float]
    noise: NotRequired[Literal["line", "model", "larger"]]
    max_peaks: NotRequired[int]
    method: Literal["matched"]
    width_px: NotRequired[float]
    length_px: NotRequired[int | None]


class Template(TypedDict):
    """The shadow of a point whose reading is known: what a pixel gets anywhere in it."""

    cells: Sequence[float]
    reading_px: float
    first_px: NotRequired[int]
    per_px: NotRequired[int]
    dark_beyond: NotRequired[bool]


class MaskMethod(TypedDict):
    """The shadow of one marker behind a coded window, at most one a line."""

    fit_scale: NotRequired[bool]
    false_alarms_per_line: NotRequired[float]
    ambiguity_probability: NotRequired[float]
    misfit_probability: NotRequired[float]
    method: Literal["mask"]
    estimator: NotRequired[Literal["fit", "correlation"]]
    template: NotRequired[Template | None]
    profile_id: NotRequired[str | None]
    sensors: NotRequired[Sequence[str] | None]


class PixelNoise(TypedDict):
    """Conversion and noise of the sensor that the scans come from."""

    electrons_per_count: float
    read_noise_electrons: float
    offset_counts: NotRequired[float]
    full_scale_counts: NotRequired[int]


class LineScanRequest(TypedDict):
    """Lines to look for peaks in."""

    scans: Sequence[Sequence[int]]
    method: CentroidMethod | FitMethod | ChainMethod | MatchedMethod | MaskMethod
    noise: NotRequired[PixelNoise | None]
    offset_counts: NotRequired[float | None]
    detail: NotRequired[bool]


class NewDeviceProfile(TypedDict):
    """A profile to keep."""

    toml: str


class PlanRequest(TypedDict):
    """A profile to plan, which is not kept."""

    toml: str
    grid: NotRequired[int]


class NewApiKey(TypedDict):
    """A key to make."""

    name: str
    scopes: Sequence[
        Literal[
            "read:stream",
            "read:calibration",
            "read:audit",
            "operate:holds",
            "operate:devices",
            "operate:recordings",
            "operate:checks",
            "write:tools",
            "write:registrations",
            "write:holds",
            "write:calibrations",
            "write:recordings",
            "write:results",
            "activate:calibrations",
            "admin:devices",
            "admin:webhooks",
            "admin:keys",
        ]
    ]
    expires_at: NotRequired[datetime | None]


class NewWebhook(TypedDict):
    """Request of a webhook: its address and its events."""

    id: NotRequired[str | None]
    title: str
    url: str
    event_types: Sequence[
        Literal["hold.held", "hold.released", "device.lost", "device.recovered", "drift.detected"]
    ]
    enabled: NotRequired[bool]


class WebhookChange(TypedDict):
    """Changes of a webhook; members left out stay. Another secret needs another webhook."""

    title: NotRequired[str]
    url: NotRequired[str]
    event_types: NotRequired[
        Sequence[
            Literal[
                "hold.held", "hold.released", "device.lost", "device.recovered", "drift.detected"
            ]
        ]
    ]
    enabled: NotRequired[bool]


class NewQualityCheck(TypedDict):
    """A quality check to make."""

    id: NotRequired[str | None]
    duration_s: NotRequired[float]
    tolerance_mm: NotRequired[float | None]
    note: NotRequired[str]
    kind: Literal["single-point"] | Literal["point-to-point"]
    marker: NotRequired[int | None]
    reference_position_mm: NotRequired[Sequence[float] | None]
    markers: NotRequired[Sequence[int] | None]
    reference_mm: NotRequired[float]
    reference_sigma_mm: NotRequired[float]


class ReferenceMarker(TypedDict):
    """A strobed marker that is fixed to where the device stands."""

    marker: int


class WatchSettings(TypedDict):
    """Settings of watching a device's drift."""

    interval_s: NotRequired[float]
    reference: NotRequired[ReferenceMarker | None]
