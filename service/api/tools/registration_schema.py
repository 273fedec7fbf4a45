"""Registrations as clients send and receive them."""

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Discriminator, Field, RootModel, Tag

from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import (
    Moment,
    Name,
    Note,
    Position,
    RequestModel,
    ResponseModel,
    Slug,
)
from service.api.tools.schema import Marker, Matrix3, Matrix6
from service.api.tools.surface_schema import SurfaceFit, SurfaceInput, SurfaceSummary

MIN_PAIRS = 3
MAX_PAIRS = 200
MIN_SURFACE_POINTS = 12

Kind = Literal["paired-points", "three-markers", "surface"]
Matrix4 = tuple[tuple[float, float, float, float], ...]
Sigma = Annotated[float, Field(gt=0, le=1e3)]


class Fiducial(RequestModel):
    """A point whose place is known in the frame and was measured."""

    name: Name
    frame_mm: Position = Field(description="Its place in the frame, such as an image's.")
    measured_mm: Position = Field(
        description="Where it was measured, in the tracker's frame or the reference tool's."
    )
    measured_covariance_mm2: Matrix3 | None = Field(
        default=None, description="Covariance of what was measured; null: `measured_sigma_mm`."
    )


class Target(RequestModel):
    """A place in the frame at which the error is asked for."""

    name: Name
    frame_mm: Position


class _Named(RequestModel):
    """Members of registration requests of all kinds."""

    id: Slug = Field(
        description="Name of the frame; unique among all registrations and tools. Not `tracker`."
    )
    device_id: Slug
    targets: Annotated[list[Target], Field(max_length=MAX_PAIRS), FIRST_ERROR_ONLY] = Field(
        default_factory=list, description="Places in the frame at which the error is asked for."
    )
    note: Note = ""


class _Measured(_Named):
    reference_id: Slug | None = Field(
        default=None,
        description="The tool that the points were measured relative to, such as one that is "
        "fixed to the patient: the frame goes with it. null: the tracker.",
    )


class NewPairedPoints(_Measured):
    """Points whose places are known in the frame, and were measured."""

    kind: Literal["paired-points"] = "paired-points"
    fiducials: Annotated[
        list[Fiducial], Field(min_length=MIN_PAIRS, max_length=MAX_PAIRS), FIRST_ERROR_ONLY
    ]
    frame_sigma_mm: Sigma | None = Field(
        default=None,
        description="Standard deviation of each coordinate in the frame; null: not known.",
    )
    measured_sigma_mm: Sigma | None = Field(
        default=None,
        description="The same of what was measured, of fiducials without a covariance. Give it "
        "for all or none: without any deviation all fiducials are taken to err alike.",
    )


class NewThreeMarkers(_Measured):
    """Three markers that make a frame: M1 its origin, M2 on its x axis, M3 at a positive y.

    Give where they were measured, or the numbers of three strobed markers, which are looked at
    while they are held still.
    """

    kind: Literal["three-markers"]
    measured_mm: tuple[Position, Position, Position] | None = Field(
        default=None,
        description="M1, M2 and M3 in the tracker's frame or the reference tool's.",
    )
    measured_covariance_mm2: tuple[Matrix3, Matrix3, Matrix3] | None = Field(
        default=None, description="Their covariances; null: `measured_sigma_mm`."
    )
    measured_sigma_mm: Sigma | None = Field(
        default=None, description="Standard deviation of each of their coordinates."
    )
    strobe_markers: tuple[Marker, Marker, Marker] | None = Field(
        default=None, description="Strobed markers that are M1, M2 and M3, to be measured now."
    )
    duration_s: Annotated[float, Field(gt=0, le=60)] = Field(
        default=1.0, description="How long strobed markers are looked at."
    )


class _SurfaceOptions(_Named):
    kind: Literal["surface"]
    parent_id: Slug = Field(
        description="The registration of the same frame that is refined: it is the start, and its "
        "`reference_id` that of the new one."
    )
    points_mm: Annotated[list[Position], Field(min_length=MIN_SURFACE_POINTS), FIRST_ERROR_ONLY] = (
        Field(
            description="Measured on the surface, in the tracker's frame or that of the earlier "
            "registration's reference tool."
        )
    )
    trim: Annotated[float, Field(ge=0, lt=0.5)] = Field(
        default=0.1, description="Share of the points, those furthest off, that is left out."
    )
    max_rms_mm: Annotated[float, Field(gt=0, le=1e3)] = Field(
        default=5.0, description="Largest RMS distance of the others from the surface."
    )
    initial_rotation_tolerance_deg: Annotated[float, Field(ge=0, le=45)] = Field(
        default=5.0,
        description="By how much the earlier registration may be turned off: other answers within "
        "this are looked for, and what lies further off is refused; 0: neither.",
    )
    initial_shift_tolerance_mm: Annotated[float, Field(ge=0, le=1e3)] = Field(
        default=5.0,
        description="By how much it may be shifted off, in the middle of the points; the same.",
    )


class NewSurface(_SurfaceOptions):
    """Points measured on a surface, such as skin, that is known in the frame, such as an image's.

    They refine an earlier registration.
    """

    surface: SurfaceInput


class StoredSurfaceRequest(_SurfaceOptions):
    """Stored request of a registration by a surface, with a summary of the surface."""

    surface: SurfaceSummary


def _kind_of(given: Any) -> Any:
    """Return the kind of a registration request; the default is paired points."""
    if isinstance(given, dict):
        return given.get("kind", "paired-points")
    return getattr(given, "kind", "paired-points")


_KIND = Discriminator(
    _kind_of,
    custom_error_type="unknown_kind",
    custom_error_message="Input should have the kind paired-points, three-markers or surface",
)


class NewRegistration(
    RootModel[
        Annotated[
            Annotated[NewPairedPoints, Tag("paired-points")]
            | Annotated[NewThreeMarkers, Tag("three-markers")]
            | Annotated[NewSurface, Tag("surface")],
            _KIND,
        ]
    ]
):
    """A registration to make: a named frame. Without a `kind` it is one of paired points."""

    model_config = ConfigDict(frozen=True)


StoredRequest = Annotated[
    Annotated[NewPairedPoints, Tag("paired-points")]
    | Annotated[NewThreeMarkers, Tag("three-markers")]
    | Annotated[StoredSurfaceRequest, Tag("surface")],
    _KIND,
]


class FiducialError(ResponseModel):
    """Residual of one fiducial."""

    name: str
    residual_mm: Position = Field(description="Measured place less that of the transform.")
    error_mm: float = Field(description="Its length: the fiducial registration error.")


class TargetError(ResponseModel):
    """Expected error at a target."""

    name: str
    error_mm: float = Field(description="RMS target registration error to expect.")
    covariance_mm2: Matrix3


class FrameMarker(ResponseModel):
    """One of the three markers that make a frame."""

    name: Literal["M1", "M2", "M3"]
    measured_mm: Position
    covariance_mm2: Matrix3
    frames: int | None = Field(description="Exposures that were averaged; null: it was given.")


class Registration(ResponseModel):
    """A registration: a named frame in which poses can be asked for."""

    id: str
    kind: Kind
    device_id: str
    reference_id: str | None
    parent_id: str | None = Field(
        default=None, description="The registration that this one refined; it may be deleted."
    )
    parent_created_at: Moment | None = None
    calibration_id: str | None = Field(
        default=None,
        description="Active when it was made. Without a `reference_id` the frame is one of its "
        "world: while another is active, poses in it are `INVALID`.",
    )
    table_id: str | None = Field(
        default=None,
        description="The correction table that was active with it. While another one, or none, "
        "is active, poses in the frame are `INVALID`, with a `reference_id`, too.",
    )
    matrix: Matrix4 = Field(
        description="From the frame to where points were measured, 4 x 4, row by row."
    )
    covariance: Matrix6 = Field(
        description="Of a small turn [rad] on the left and of the translation [mm]."
    )
    fre_mm: float | None = Field(
        default=None, description="RMS fiducial registration error, of paired points."
    )
    fle_mm: float | None = Field(
        default=None, description="Localisation error that the residuals of paired points tell of."
    )
    residual_sigma: float | None = Field(
        default=None,
        description="Root of chi2 per degree of freedom, of paired points; null: no deviations "
        "were given.",
    )
    fiducials: list[FiducialError] = Field(default_factory=list, description="Of paired points.")
    markers: list[FrameMarker] = Field(default_factory=list, description="Of three markers.")
    surface: SurfaceFit | None = Field(
        default=None, description="How the points lie on the surface; null: of another kind."
    )
    targets: list[TargetError]
    warnings: list[str]
    request: StoredRequest
    note: str
    created_at: Moment
