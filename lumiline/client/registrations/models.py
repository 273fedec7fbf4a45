"""What the server answers about registrations, and the transforms between frames."""

from lumiline.client.response_model import Matrix3, Matrix4, Matrix6, ResponseModel, Vector3


class FiducialError(ResponseModel):
    """How a fiducial fits."""

    name: str
    residual_mm: Vector3
    error_mm: float


class TargetError(ResponseModel):
    """What to expect at a target."""

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
    """How points lie on a surface, and how well it holds them."""

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
    """A frame, and whether it is connected now; those with the same root are with one another."""

    frame: str
    kind: str
    to: str | None
    connected: bool
    status: str
    reason: str | None
    root: str


class Frames(ResponseModel):
    """A device's frames at its newest frame."""

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
    quaternion_wxyz: tuple[float, float, float, float] | None
    covariance: Matrix6 | None
