"""What the server answers about registrations, and the transforms between frames."""

from lumiline.client.answer import Answer, Matrix3, Matrix4, Matrix6, Vector3


class FiducialError(Answer):
    """How a fiducial fits."""

    name: str
    residual_mm: Vector3
    error_mm: float


class TargetError(Answer):
    """What to expect at a target."""

    name: str
    error_mm: float
    covariance_mm2: Matrix3


class FrameMarker(Answer):
    """One of three markers that make a frame; measured in ``frames`` exposures, or given."""

    name: str
    measured_mm: Vector3
    covariance_mm2: Matrix3
    frames: int | None


class SurfaceFit(Answer):
    """How points lie on a surface, and how well it holds them."""

    rms_mm: float
    steps: int
    points: int
    distance_mm: tuple[float, ...]
    used: tuple[bool, ...]
    hold: float
    weakest: str
    turned_deg: float
    shifted_mm: float


class Registration(Answer):
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


class FrameState(Answer):
    """A frame, and whether it is connected now; those with the same root are with one another."""

    frame: str
    kind: str
    to: str | None
    connected: bool
    status: str
    reason: str | None
    root: str


class Frames(Answer):
    """A device's frames at its newest frame."""

    device: str
    exposure_ns: int | None
    sequence: int | None
    age_s: float | None
    frames: tuple[FrameState, ...]


class FrameTransform(Answer):
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
