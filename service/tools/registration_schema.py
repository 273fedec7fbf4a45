"""Registrations as clients send and receive them."""

from typing import Annotated

from pydantic import Field

from service.schema import Document, Given, Moment, Name, Note, Position, Slug
from service.tools.schema import Matrix3, Matrix6

LEAST_PAIRS = 3
MOST_PAIRS = 200

Sigma = Annotated[float, Field(gt=0, le=1e3)]


class Fiducial(Given):
    """A point whose place is known in the frame and was measured."""

    name: Name
    frame_mm: Position = Field(description="Its place in the frame, such as an image's.")
    measured_mm: Position = Field(
        description="Where it was measured, in the tracker's frame or the reference tool's."
    )
    measured_covariance_mm2: Matrix3 | None = Field(
        default=None, description="Covariance of what was measured; null: `measured_sigma_mm`."
    )


class Target(Given):
    """A place in the frame at which the error is asked for."""

    name: Name
    frame_mm: Position


class NewRegistration(Given):
    """A registration to make: paired points to a named frame."""

    id: Slug = Field(
        description="Name of the frame; unique among all registrations and tools. Not `tracker`."
    )
    device: Slug
    reference: Slug | None = Field(
        default=None,
        description="The tool that the points were measured relative to, such as one that is "
        "fixed to the patient: the frame goes with it. null: the tracker.",
    )
    fiducials: Annotated[list[Fiducial], Field(min_length=LEAST_PAIRS, max_length=MOST_PAIRS)]
    targets: Annotated[list[Target], Field(max_length=MOST_PAIRS)] = Field(default_factory=list)
    frame_sigma_mm: Sigma | None = Field(
        default=None,
        description="Standard deviation of each coordinate in the frame; null: not known.",
    )
    measured_sigma_mm: Sigma | None = Field(
        default=None,
        description="The same of what was measured, of fiducials without a covariance. Give it "
        "for all or none: without any deviation all fiducials are taken to err alike.",
    )
    note: Note = ""


class FiducialError(Document):
    """How a fiducial fits."""

    name: str
    residual_mm: Position = Field(description="Measured place less that of the transform.")
    error_mm: float = Field(description="Its length: the fiducial registration error.")


class TargetError(Document):
    """What to expect at a target."""

    name: str
    error_mm: float = Field(description="RMS target registration error to expect.")
    covariance_mm2: Matrix3


class Registration(Document):
    """A registration: a named frame in which poses can be asked for."""

    id: str
    device: str
    reference: str | None
    calibration: str | None = Field(
        default=None,
        description="Active when it was made. Without a `reference` the frame is one of its world: "
        "while another is in force, poses in it are `INVALID`.",
    )
    table: str | None = Field(
        default=None,
        description="The correction table that was active with it. While another one, or none, "
        "is in force, poses in the frame are `INVALID`, with a `reference`, too.",
    )
    matrix: tuple[tuple[float, float, float, float], ...] = Field(
        description="From the frame to where points were measured, 4 x 4, row by row."
    )
    covariance: Matrix6 = Field(
        description="Of a small turn [rad] on the left and of the translation [mm]."
    )
    fre_mm: float = Field(description="RMS fiducial registration error.")
    fle_mm: float = Field(description="Localisation error that the residuals tell of.")
    residual_sigma: float | None = Field(
        description="Root of chi2 per degree of freedom; null: no deviations were given."
    )
    fiducials: list[FiducialError]
    targets: list[TargetError]
    warnings: list[str]
    asked: NewRegistration
    note: str
    created_at: Moment
