"""Reconstructions as clients send and receive them."""

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from compute.reconstruction.point_batch import PointEstimate
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import (
    Moment,
    Name,
    RequestModel,
    ResponseModel,
    Slug,
)
from service.api.calibrations.schema import MAX_POINTS, Readings


class ObservedPoint(RequestModel):
    """A point of unknown position and what the sensors read of it."""

    name: Name
    readings: Readings


class NewReconstruction(RequestModel):
    """Readings of which points are computed."""

    id: Slug | None = Field(default=None, description="Left out or null: the server makes one.")
    device_id: Slug
    calibration_id: Slug | None = Field(
        default=None,
        description="One of the device's, without a table; left out or null: its active one, with "
        "its active correction table.",
    )
    points: Annotated[
        list[ObservedPoint], Field(min_length=1, max_length=MAX_POINTS), FIRST_ERROR_ONLY
    ]


@dataclass(frozen=True)
class NamedEstimate(PointEstimate):
    """A reconstructed point under its name.

    Args:
        name: the point's name.
        excluded: names of the sensors whose readings were left out as wrong.
        detectable_px: smallest error of each used sensor's reading that would have been found with
            a probability of 0.8 [px]; null: nothing checks the reading.
    """

    name: str
    excluded: tuple[str, ...] = ()
    detectable_px: dict[str, float | None] = field(default_factory=dict)


class ReconstructionSummary(ResponseModel):
    """A reconstruction without its points."""

    id: str
    device_id: str
    calibration_id: str
    table_id: str | None = Field(description="The correction table used with it; null: none.")
    point_count: int
    created_at: Moment


class Reconstruction(ReconstructionSummary):
    """A reconstruction: readings and estimates, in the order of the points."""

    points: list[ObservedPoint]
    estimates: list[NamedEstimate] = Field(
        description="`position_mm` is null where there is none; `flags` say why: "
        "`too-few-sensors` (three are needed), `degenerate`, `no-convergence`. `outside-map`: the "
        "correction table does not support a reading there. `no-covariance`: it lies beyond the "
        "table, and `covariance_mm2` is null. `reading-excluded`: one or two "
        "readings contradicted the others and were left out. `inconsistent` with "
        "`not-identifiable`: a reading is wrong, and the others do not tell which."
    )
