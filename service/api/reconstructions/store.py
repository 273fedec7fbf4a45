"""Reconstructions in the database."""

import secrets
from datetime import UTC, datetime

from pydantic import TypeAdapter
from sqlalchemy import Select
from sqlalchemy.orm import Session, defer

from service.api.calibrations.store import active_id, get_calibration
from service.api.correction_tables.store import TABLES
from service.api.devices.store import active
from service.api.reconstructions.schema import (
    NamedEstimate,
    NewReconstruction,
    ObservedPoint,
    Reconstruction,
    ReconstructionSummary,
)
from service.database.engine import Resource
from service.database.models import CalibrationRow, CorrectionTableRow, ReconstructionRow
from service.problems.errors import (
    CalibrationOfAnotherDevice,
    CalibrationRetired,
    NoActiveCalibration,
    ReconstructionExists,
    UnknownReconstruction,
)

RECONSTRUCTIONS = Resource(
    ReconstructionRow, "reconstruction", UnknownReconstruction, ReconstructionExists
)
_ESTIMATE = TypeAdapter(NamedEstimate)


def calibration_for(session: Session, request: NewReconstruction) -> CalibrationRow:
    """Return the calibration that a request names, or its device's active one.

    Raises:
        NoActiveCalibration, UnknownCalibration, CalibrationOfAnotherDevice, CalibrationRetired.
    """
    calibration_id = request.calibration_id or active_id(session, request.device_id)
    if calibration_id is None:
        raise NoActiveCalibration(
            f'device "{request.device_id}" has no active calibration; activate one, or name one in '
            "the request",
            device_id=request.device_id,
        )
    row = get_calibration(session, calibration_id)
    if row.device_id != request.device_id:
        raise CalibrationOfAnotherDevice(
            f'calibration "{row.id}" belongs to device "{row.device_id}", the readings to device '
            f'"{request.device_id}"; use a calibration of "{request.device_id}"',
            calibration_id=row.id,
            device_id=request.device_id,
        )
    if row.retired_at is not None:
        raise CalibrationRetired(
            f'calibration "{row.id}" was retired on {row.retired_at:%Y-%m-%d}; use one that is '
            "available",
            calibration_id=row.id,
        )
    return row


def table_for(session: Session, request: NewReconstruction) -> CorrectionTableRow | None:
    """Return the device's active table, None where the request names a calibration itself."""
    pointer = active(session, request.device_id)
    if request.calibration_id is not None or pointer is None or pointer.table_id is None:
        return None
    return TABLES.get(session, pointer.table_id)


def add_reconstruction(
    session: Session,
    request: NewReconstruction,
    calibration_id: str,
    table_id: str | None,
    estimates: list[NamedEstimate],
) -> ReconstructionRow:
    """Store a reconstruction; raises ReconstructionExists."""
    row = ReconstructionRow(
        id=request.id or f"rec-{secrets.token_hex(8)}",
        device_id=request.device_id,
        calibration_id=calibration_id,
        table_id=table_id,
        # One by one: the interpreter's lock is held for as long as the library is at work.
        points=[point.model_dump(mode="json") for point in request.points],
        estimates=[_ESTIMATE.dump_python(estimate, mode="json") for estimate in estimates],
        point_count=len(request.points),
        created_at=datetime.now(UTC),
    )
    return RECONSTRUCTIONS.insert(session, row)


def reconstructions(device_id: str | None) -> Select[ReconstructionRow]:
    """Return those that the filter matches, newest first, without their points."""
    return RECONSTRUCTIONS.newest_first(device_id=device_id).options(
        defer(ReconstructionRow.points), defer(ReconstructionRow.estimates)
    )


def summary(row: ReconstructionRow) -> ReconstructionSummary:
    """Return the reconstruction without its points."""
    return ReconstructionSummary(
        id=row.id,
        device_id=row.device_id,
        calibration_id=row.calibration_id,
        table_id=row.table_id,
        point_count=row.point_count,
        created_at=row.created_at,
    )


def document(row: ReconstructionRow) -> Reconstruction:
    """Return the reconstruction as clients see it."""
    return with_points(
        row,
        [ObservedPoint.model_validate(point) for point in row.points],
        [_ESTIMATE.validate_python(estimate) for estimate in row.estimates],
    )


def with_points(
    row: ReconstructionRow, points: list[ObservedPoint], estimates: list[NamedEstimate]
) -> Reconstruction:
    """Return the same with its points and estimates, which are at hand."""
    return Reconstruction.model_construct(**vars(summary(row)), points=points, estimates=estimates)
