"""What the server answers about tools, their calibration, and points measured with them."""

from lumiline.client.response_model import Matrix3, Matrix6, ResponseModel, Vector3


class Tip(ResponseModel):
    """Where a tool's working point is, in its coordinates."""

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
    """The newest pose of a tool, or why there is none; only a pose that is OK is one to use."""

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
    quaternion_wxyz: tuple[float, float, float, float] | None
    covariance: Matrix6 | None
    tip_mm: Vector3 | None
    tip_covariance_mm2: Matrix3 | None
    residual_sigma: float | None
    markers_used: int
    readings_used: int


class ToolCalibration(ResponseModel):
    """What a pivot or spin calibration found."""

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
    """A point that a tool's tip was held on."""

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
