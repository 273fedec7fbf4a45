"""Reconstructions in the database."""

import secrets
from datetime import UTC, datetime

from pydantic import TypeAdapter
from sqlalchemy import Select, select
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
from service.database.engine import insert
from service.database.models import CalibrationRow, CorrectionTableRow, ReconstructionRow
from service.problems.errors import (
    CalibrationOfAnotherDevice,
    CalibrationRetired,
    NoActiveCalibration,
    ReconstructionExists,
    UnknownReconstruction,
)

_POINTS = TypeAdapter(list[ObservedPoint])
_ESTIMATES = TypeAdapter(list[NamedEstimate])


def calibration_for(session: Session, request: NewReconstruction) -> CalibrationRow:
    """Return the calibration that a request names, or its device's active one.

    Raises:
        NoActiveCalibration, UnknownCalibration, CalibrationOfAnotherDevice, CalibrationRetired.
    """
    calibration_id = request.calibration or active_id(session, request.device)
    if calibration_id is None:
        raise NoActiveCalibration(
            f'device "{request.device}" has no active calibration; activate one, or name one in '
            "the request",
            device=request.device,
        )
    row = get_calibration(session, calibration_id)
    if row.device_id != request.device:
        raise CalibrationOfAnotherDevice(
            f'calibration "{row.id}" belongs to device "{row.device_id}", the readings to device '
            f'"{request.device}"; use a calibration of "{request.device}"',
            calibration=row.id,
            device=request.device,
        )
    if row.retired_at is not None:
        raise CalibrationRetired(
            f'calibration "{row.id}" was retired on {row.retired_at:%Y-%m-%d}; use one that is '
            "available",
            calibration=row.id,
        )
    return row


def table_for(session: Session, request: NewReconstruction) -> CorrectionTableRow | None:
    """Return the device's active table, None where the request names a calibration itself."""
    pointer = active(session, request.device)
    if request.calibration is not None or pointer is None or pointer.table_id is None:
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
    taken = ReconstructionExists(
        f'reconstruction "{request.id}" exists already; choose another id, or leave it out',
        reconstruction=request.id,
    )
    if request.id is not None and session.get(ReconstructionRow, request.id) is not None:
        raise taken
    row = ReconstructionRow(
        id=request.id or f"rec-{secrets.token_hex(8)}",
        device_id=request.device,
        calibration_id=calibration_id,
        table_id=table_id,
        points=_POINTS.dump_python(request.points, mode="json"),
        estimates=_ESTIMATES.dump_python(estimates, mode="json"),
        point_count=len(request.points),
        created_at=datetime.now(UTC),
    )
    insert(session, row, taken)
    return row


def get_reconstruction(session: Session, reconstruction_id: str) -> ReconstructionRow:
    """Return a reconstruction; raises UnknownReconstruction."""
    row = session.get(ReconstructionRow, reconstruction_id)
    if row is None:
        raise UnknownReconstruction(
            f'there is no reconstruction "{reconstruction_id}"; GET /api/v1/reconstructions '
            "lists them",
            reconstruction=reconstruction_id,
        )
    return row


def reconstructions(device_id: str | None) -> Select[ReconstructionRow]:
    """Return those that the filter matches, newest first, without their points."""
    found = (
        select(ReconstructionRow)
        .options(defer(ReconstructionRow.points), defer(ReconstructionRow.estimates))
        .order_by(ReconstructionRow.created_at.desc(), ReconstructionRow.id)
    )
    return found if device_id is None else found.where(ReconstructionRow.device_id == device_id)


def summary(row: ReconstructionRow) -> ReconstructionSummary:
    """Return the reconstruction without its points."""
    return ReconstructionSummary(
        id=row.id,
        device=row.device_id,
        calibration_id=row.calibration_id,
        table=row.table_id,
        point_count=row.point_count,
        created_at=row.created_at,
    )


def document(row: ReconstructionRow) -> Reconstruction:
    """Return the reconstruction as clients see it."""
    return Reconstruction(
        **vars(summary(row)),
        points=_POINTS.validate_python(row.points),
        estimates=_ESTIMATES.validate_python(row.estimates),
    )
