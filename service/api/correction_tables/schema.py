"""Correction tables as clients see them; the numbers are in the HDF5 file."""

from typing import Any, Literal

from pydantic import Field

from compute.camera.model import Vector3
from service.api.base_models import Moment, ResponseModel


class Grid(ResponseModel):
    """The box of voxels."""

    origin_mm: Vector3
    pitch_mm: Vector3
    cells: tuple[int, int, int]


class CorrectionTableDocument(ResponseModel):
    """A correction table, without its numbers."""

    id: str
    device: str
    calibration: str = Field(description="The calibration it belongs to, its parent.")
    calibration_hash: str = Field(description="The parent's content hash.")
    content_hash: str = Field(description="Of the table with its provenance; see the guide.")
    active: bool = Field(description="Whether the device uses it now.")
    origin: Literal["run", "upload"]
    note: str
    sensors: list[str]
    grid: Grid
    degree: Literal[1, 3] = Field(description="Of the splines; 1: trilinear.")
    valid_share: list[float] = Field(description="Share of cells vouched for, by sensor.")
    max_correction_px: list[float] = Field(description="Largest coefficient there, by sensor.")
    settings: dict[str, Any] = Field(description="How it was asked to be made.")
    validation: dict[str, Any] = Field(description="Figures on points that it never saw.")
    made_at: Moment = Field(description="When it was computed.")
    created_at: Moment = Field(description="When it was stored here.")
