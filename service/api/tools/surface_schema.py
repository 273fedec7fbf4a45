"""Surfaces in registrations and residuals of points on them, as clients send and receive them."""

from typing import Annotated, Literal

from pydantic import Field

from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import Position, RequestModel, ResponseModel

Direction = tuple[
    Annotated[float, Field(ge=-1e6, le=1e6)],
    Annotated[float, Field(ge=-1e6, le=1e6)],
    Annotated[float, Field(ge=-1e6, le=1e6)],
]
Index = Annotated[int, Field(ge=0, le=100_000_000)]


class MeshInput(RequestModel):
    """A surface of triangles."""

    kind: Literal["mesh"]
    vertices_mm: Annotated[list[Position], FIRST_ERROR_ONLY] = Field(
        min_length=3, description="Places in the frame."
    )
    triangles: Annotated[
        list[tuple[Index, Index, Index]], Field(min_length=1), FIRST_ERROR_ONLY
    ] = Field(description="Numbers of their vertices, from 0. Which side is out does not matter.")


class PointCloudInput(RequestModel):
    """A surface as points of it."""

    kind: Literal["points"]
    points_mm: Annotated[list[Position], Field(min_length=1), FIRST_ERROR_ONLY] = Field(
        description="Places in the frame, as close to one another as the surface bends."
    )
    normals: Annotated[list[Direction], FIRST_ERROR_ONLY] | None = Field(
        default=None,
        description="Of the surface at each point, of any length. With them points may slide "
        "along it, and fewer do; null: not known.",
    )


SurfaceInput = Annotated[MeshInput | PointCloudInput, Field(discriminator="kind")]


class SurfaceSummary(ResponseModel):
    """Summary of a given surface, by which another can be compared; the surface is not kept."""

    kind: Literal["mesh", "points"]
    vertices: int = Field(description="Vertices, or points.")
    triangles: int | None = Field(description="null: of points.")
    sha256: str = Field(
        description="Of the coordinates as little-endian float64, row by row, then the triangles' "
        "numbers as int64 or the normals as float64."
    )


class AlternativeSolution(ResponseModel):
    """Another place where the points lie on the surface about as well."""

    matrix: tuple[tuple[float, float, float, float], ...] = Field(
        description="From the frame to where points were measured, 4 x 4, row by row."
    )
    rms_mm: float


class SurfaceFit(ResponseModel):
    """Residuals of points on a surface, and how well it constrains the registration."""

    rms_mm: float = Field(description="RMS distance of the points that were used.")
    iterations: int = Field(description="That it took until nothing was gained any more.")
    points: int = Field(description="That were used.")
    distance_mm: list[float] = Field(description="Of each point from the surface.")
    used: list[bool] = Field(description="Whether each point was, or was trimmed off.")
    stiffness_ratio: float = Field(
        description="Stiffness of the worst held motion over that of the best, 0 to 1: 0 leaves "
        "it undetermined."
    )
    weakest_motion: str = Field(description="That motion, in the frame's coordinates.")
    rotation_deg: float = Field(description="By how much the earlier registration was turned.")
    shift_mm: float = Field(description="By how much, in the middle of the points, shifted.")
    alternative: AlternativeSolution | None = Field(
        description="The best of other answers near the start; null: none was found."
    )
