"""Models of the server's answers; members that a newer server adds are kept as attributes."""

from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Row6 = tuple[float, float, float, float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Matrix4 = tuple[tuple[float, float, float, float], ...]
Matrix6 = tuple[Row6, Row6, Row6, Row6, Row6, Row6]


class ResponseModel(BaseModel):
    """Base of the models of the server's answers."""

    model_config = ConfigDict(frozen=True, extra="allow")


class Sensor(ResponseModel):
    """A line sensor."""

    name: str
    pixels: int
    pitch_um: float


class Device(ResponseModel):
    """A device."""

    id: str
    title: str
    source: dict[str, Any]
    sensors: tuple[Sensor, ...]
    autostart: bool
    active_calibration_id: str | None
    active_table_id: str | None
    active_radiometric_id: str | None = None


class LiveBadPixel(ResponseModel):
    """A pixel that a device's frames have shown to be bad since it was started."""

    sensor: str
    pixel: int
    kind: str
    since: datetime


class DeviceStatus(ResponseModel):
    """State of a device and its counts of frames."""

    state: str
    reason: str | None = None
    calibration_id: str | None = None
    table_id: str | None = None
    radiometric_id: str | None = None
    bad_pixels: list[LiveBadPixel] = []
    frames: int = 0
    frames_lost_device: int = 0
    frames_dropped_ring: int = 0
    frames_processed: int = 0
    subscribers: int = 0


class Calibration(ResponseModel):
    """A calibration without its numbers; ``Client.request`` gets the whole document."""

    id: str
    device: str
    state: str
    provenance: str
    method: str
    note: str
    content_hash: str


class RadiometricSensor(ResponseModel):
    """Figures of a sensor's radiometric calibration (EMVA 1288)."""

    sensor: str
    gain_electrons_per_count: float
    read_noise_counts: float
    dark_offset_counts: float
    prnu: float
    dsnu_counts: float
    linearity_error: float | None = None
    bad_pixels: int
    temperature_c: float | None = None


class RadiometricCalibration(ResponseModel):
    """A radiometric calibration of a device's sensors."""

    id: str
    device: str
    active: bool
    origin: str
    sensors: tuple[RadiometricSensor, ...]
    content_hash: str
    note: str


class RadiometricCapture(ResponseModel):
    """A session of dark and flat captures; ``instruction`` says what to do now."""

    id: str
    device: str
    captured: tuple[dict[str, Any], ...]
    next: str | None
    instruction: str
    left: int


class Estimate(ResponseModel):
    """A reconstructed point; no position where ``flags`` say why not."""

    name: str
    position_mm: Vector3 | None
    covariance_mm2: Matrix3 | None
    residual_sigma: float | None
    sensors: tuple[str, ...]
    flags: tuple[str, ...]
    excluded: tuple[str, ...] = ()
    detectable_px: dict[str, float | None] = {}
    external_reliability_mm: float | None = None


class Reconstruction(ResponseModel):
    """Points computed from readings that were posted."""

    id: str
    device: str
    calibration_id: str
    table: str | None
    estimates: tuple[Estimate, ...]


class Tip(ResponseModel):
    """Tip of a tool, in the tool's coordinates."""

    position_mm: Vector3 | None
    covariance_mm2: Matrix3 | None = None
    axis: Vector3 | None = None


class Tool(ResponseModel):
    """A tool."""

    id: str
    device: str
    title: str
    markers_mm: tuple[Vector3, ...]
    strobe_markers: tuple[int, ...] | None
    tip: Tip
    reference: str | None


class Pose(ResponseModel):
    """The newest pose of a tool, or why there is none; use it only where ``status`` is OK."""

    tool: str
    device: str
    frame: str
    status: str
    reason: str | None
    exposure_ns: int | None
    sequence: int | None
    age_s: float | None
    translation_mm: Vector3 | None
    rotation: Matrix3 | None
    quaternion_wxyz: Quaternion | None
    covariance: Matrix6 | None
    tip_mm: Vector3 | None
    tip_covariance_mm2: Matrix3 | None
    residual_sigma: float | None
    markers_used: int
    readings_used: int


class ToolCalibration(ResponseModel):
    """Result of a pivot or spin calibration."""

    id: str
    tool: str
    kind: str
    applied: bool
    poses: int
    outliers: int
    tip_mm: Vector3 | None
    axis: Vector3 | None
    point_mm: Vector3 | None
    rms_mm: float


class MeasuredPoint(ResponseModel):
    """A point measured with a tool's tip."""

    name: str | None
    tool: str
    device: str
    frame: str
    position_mm: Vector3
    covariance_mm2: Matrix3
    sigma_mm: float
    drift_mm: float
    frames: int
    first_ns: int
    last_ns: int


class FiducialError(ResponseModel):
    """Registration error at a fiducial."""

    name: str
    residual_mm: Vector3
    error_mm: float


class TargetError(ResponseModel):
    """Predicted registration error at a target."""

    name: str
    error_mm: float
    covariance_mm2: Matrix3


class FrameMarker(ResponseModel):
    """One of three markers that make a frame; measured in ``frames`` exposures, or given."""

    name: str
    measured_mm: Vector3
    covariance_mm2: Matrix3
    frames: int | None


class SurfaceFit(ResponseModel):
    """Fit of measured points to a surface, and how well it is conditioned."""

    rms_mm: float
    iterations: int
    points: int
    distance_mm: tuple[float, ...]
    used: tuple[bool, ...]
    stiffness_ratio: float
    weakest_motion: str
    rotation_deg: float
    shift_mm: float


class Registration(ResponseModel):
    """A named frame: from paired points, three markers, or a surface."""

    id: str
    kind: str = "paired-points"
    device: str
    reference: str | None
    parent: str | None = None
    matrix: Matrix4
    covariance: Matrix6
    fre_mm: float | None = None
    fle_mm: float | None = None
    residual_sigma: float | None = None
    fiducials: tuple[FiducialError, ...] = ()
    markers: tuple[FrameMarker, ...] = ()
    surface: SurfaceFit | None = None
    targets: tuple[TargetError, ...]
    warnings: tuple[str, ...]


class FrameState(ResponseModel):
    """A frame, and whether it is connected now; frames of one root are connected."""

    frame: str
    kind: str
    to: str | None
    connected: bool
    status: str
    reason: str | None
    root: str


class Frames(ResponseModel):
    """A device's coordinate frames at its newest exposure."""

    device: str
    exposure_ns: int | None
    sequence: int | None
    age_s: float | None
    frames: tuple[FrameState, ...]


class FrameTransform(ResponseModel):
    """The transform from one frame to another now, or why there is none."""

    device: str
    frame: str
    to: str
    status: str
    reason: str | None
    path: tuple[str, ...] | None
    exposure_ns: int | None
    sequence: int | None
    age_s: float | None
    matrix: Matrix4 | None
    translation_mm: Vector3 | None
    rotation: Matrix3 | None
    quaternion_wxyz: Quaternion | None
    covariance: Matrix6 | None


class BeamHold(ResponseModel):
    """A beam hold."""

    id: str
    device: str
    title: str
    watch: dict[str, Any]
    limits: dict[str, Any]
    rules: dict[str, Any]
    reference: dict[str, Any] | None


class BeamHoldStatus(ResponseModel):
    """State of a beam hold; the beam may be on only where ``held`` is false."""

    hold: str
    device: str
    held: bool
    cause: str
    reason: str | None
    since_ns: int
    exposure_ns: int | None
    sequence: int | None
    shift_mm: Vector3 | None
    rotation_rad: Vector3 | None
    probability: float | None


class Recording(ResponseModel):
    """A recording in the server's folder."""

    name: str
    device: str | None
    state: str
    reason: str | None
    contents: tuple[str, ...]
    frames: int | None
    duration_s: float | None
    size_bytes: int
    started_at: datetime | None


class Export(ResponseModel):
    """A file that an export run has made."""

    id: str
    format: str
    file_name: str
    media_type: str
    size_bytes: int
    created_at: datetime
    run: str | None
    device: str | None
    recording: str | None


class RunProblem(ResponseModel):
    """Why a run failed."""

    type: str
    title: str
    status: int
    detail: str


class Run(ResponseModel):
    """A long computation of the server: an export, a calibration, a map."""

    id: str
    kind: str
    device: str
    state: str
    progress: float
    stage: str
    result_id: str | None
    result: str | None
    problem: RunProblem | None

    @property
    def ended(self) -> bool:
        """Whether it has finished, in whatever way."""
        return self.state not in ("queued", "running")
