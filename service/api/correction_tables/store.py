"""Correction tables in the database: stored, read, activated with their calibration."""

import secrets
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np
from pydantic import Field
from sqlalchemy import select
from sqlalchemy.orm import Session

from compute.camera.model import Vector3
from service.api.base_models import Moment, ResponseModel, from_attributes
from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.store import CALIBRATIONS
from service.api.correction_tables.table_content import TableContent, check_table
from service.api.devices.store import Target, active, lock_device, move_pointer
from service.database.engine import Resource
from service.database.models import (
    ActivationRow,
    ActiveCalibrationRow,
    CalibrationRow,
    CorrectionTableRow,
    QualityCheckRow,
    ReconstructionRow,
)
from service.database.referrers import refuse_if_referred
from service.pipeline.active_calibration import ActiveCalibration, ActiveRadiometric
from service.problems.errors import (
    CorrectionTableExists,
    CorrectionTableInUse,
    NoActiveCalibration,
    TableOfAnotherCalibration,
    UnknownCorrectionTable,
)

Origin = Literal["run", "upload"]

TABLES = Resource(
    CorrectionTableRow,
    "table",
    UnknownCorrectionTable,
    CorrectionTableExists,
    "correction table",
    "exists already and is never overwritten; choose another id, or leave it out",
    "/api/v1/correction-tables",
)


class Grid(ResponseModel):
    """The box of voxels."""

    origin_mm: Vector3
    pitch_mm: Vector3
    cells: tuple[int, int, int]


class CorrectionTableDocument(ResponseModel):
    """A correction table, without its numbers."""

    id: str
    device_id: str
    calibration_id: str = Field(description="The calibration it belongs to, its parent.")
    calibration_hash: str = Field(description="The parent's content hash.")
    content_hash: str = Field(description="Of the table with its provenance; see the guide.")
    active: bool = Field(description="Whether the device uses it now.")
    origin: Origin
    note: str
    sensors: list[str]
    grid: Grid
    degree: Literal[1, 3] = Field(description="Of the splines; 1: trilinear.")
    valid_share: list[float] = Field(
        description="Share of cells that measurements support, by sensor, within the box of those "
        "that any sensor's do."
    )
    max_correction_px: list[float] = Field(description="Largest coefficient there, by sensor.")
    settings: dict[str, Any] = Field(description="How it was asked to be made.")
    validation: dict[str, Any] = Field(description="Figures on points that it never saw.")
    made_at: Moment = Field(
        description="When it was computed, perhaps on another server; part of the content hash."
    )
    created_at: Moment = Field(description="When it was stored on this server.")


def find_parent(session: Session, content: TableContent) -> CalibrationRow:
    """Return the calibration whose content has the hash that a table names.

    Of several with the same content the active one, else the newest.

    Raises:
        TableOfAnotherCalibration: there is none, or the device or sensors are others.
    """
    wanted = content.table.calibration_hash
    rows = session.scalars(
        select(CalibrationRow)
        .outerjoin(ActiveCalibrationRow, ActiveCalibrationRow.calibration_id == CalibrationRow.id)
        .where(CalibrationRow.content_hash == wanted)
        .order_by(ActiveCalibrationRow.calibration_id.is_(None), CalibrationRow.created_at.desc())
    ).all()
    if not rows:
        raise TableOfAnotherCalibration(
            f"the table belongs to the calibration with the content hash {wanted[:64]}, which is "
            "not on this server; a table works with the calibration it was made from only",
            calibration_hash=wanted[:64],
        )
    if content.device != rows[0].device_id:
        raise TableOfAnotherCalibration(
            f'the table is of device "{content.device[:63]}", its calibration "{rows[0].id}" of '
            f'"{rows[0].device_id}"; upload it as it was downloaded',
            calibration_id=rows[0].id,
            device_id=rows[0].device_id,
        )
    check_sensor_names(rows[0], content)
    return rows[0]


def check_sensor_names(calibration: CalibrationRow, content: TableContent) -> None:
    """Check that a table's sensors are the calibration's, in its order."""
    names = [fit["model"]["name"] for fit in calibration.content["result"]["sensors"]]
    if list(content.table.sensors) != names:
        raise TableOfAnotherCalibration(
            f"the table is of the sensors {', '.join(content.table.sensors)[:200]}, and its "
            f'calibration "{calibration.id}" of {", ".join(names)}',
            calibration_id=calibration.id,
        )


def add_table(
    session: Session,
    content: TableContent,
    parent: CalibrationRow,
    origin: Origin,
    note: str,
    table_id: str | None = None,
) -> CorrectionTableRow:
    """Store a table; it is not activated.

    Raises:
        CorrectionTableExists: the id is taken.
        TableOfAnotherCalibration: it is of another calibration.
        InvalidParameter, NoValidCells: see ``check_table``.
    """
    from service.api.correction_tables.hdf5_file import write_table  # takes a while to load

    TABLES.check_unused(session, table_id)
    check_sensor_names(parent, content)
    check_table(content.table)
    row = CorrectionTableRow(
        id=table_id or f"table-{secrets.token_hex(8)}",
        device_id=parent.device_id,
        calibration_id=parent.id,
        calibration_hash=content.table.calibration_hash,
        content_hash=content.content_hash(),
        origin=origin,
        note=note,
        content=content.header() | _figures(content),
        data=write_table(content),
        created_at=datetime.now(UTC),
    )
    return TABLES.insert(session, row)


def _figures(content: TableContent) -> dict[str, list[float]]:
    """Return what says at a glance how large a table's corrections are, for each sensor."""
    table = content.table
    inside = [
        np.abs(values[_valid_nodes(valid, table.degree)])
        for values, valid in zip(table.coefficients_px, table.valid, strict=True)
    ]
    # The margin beyond the measurements is valid for no sensor and does not count.
    reach = np.array([np.ptp(index) + 1 for index in np.nonzero(table.valid.any(axis=0))])
    return {
        "valid_share": [float(valid.sum() / reach.prod()) for valid in table.valid],
        "max_correction_px": [float(values.max()) for values in inside],
    }


def _valid_nodes(valid: np.ndarray, degree: int) -> np.ndarray:
    """Return which coefficients a valid cell depends on."""
    touched = np.pad(valid, (0, degree))
    for axis in range(3):
        shifted = [np.roll(touched, step, axis) for step in range(degree + 1)]
        touched = np.logical_or.reduce(shifted)
    return touched


def content_of(row: CorrectionTableRow) -> TableContent:
    """Return a stored table."""
    from service.api.correction_tables.hdf5_file import read_table

    return read_table(row.data)


def activate_table(session: Session, table_id: str) -> CorrectionTableRow:
    """Let the table's device use it with the active calibration, which must be its parent.

    Raises:
        UnknownCorrectionTable.
        NoActiveCalibration: the device has none.
        TableOfAnotherCalibration: the active calibration is another one.
    """
    row = TABLES.get(session, table_id)
    lock_device(session, row.device_id)
    pointer = active(session, row.device_id)
    if pointer is None:
        raise NoActiveCalibration(
            f'device "{row.device_id}" has no active calibration; activate the table\'s, '
            f'"{row.calibration_id}"',
            device_id=row.device_id,
        )
    calibration = CALIBRATIONS.get(session, pointer.calibration_id)
    if calibration.content_hash != row.calibration_hash:
        raise TableOfAnotherCalibration(
            f'table "{row.id}" belongs to the calibration "{row.calibration_id}" (content hash '
            f'{row.calibration_hash[:12]}...); active is "{calibration.id}" '
            f"({calibration.content_hash[:12]}...): activate that calibration first, or a table "
            "made with this one",
            table_id=row.id,
            calibration_id=row.calibration_id,
            active_calibration=calibration.id,
        )
    move_pointer(session, row.device_id, Target(calibration.id, row.id))
    return row


def deactivate_table(session: Session, table_id: str) -> CorrectionTableRow:
    """Let the table's device go on without it; one that is not active stays so.

    Raises:
        UnknownCorrectionTable.
    """
    row = TABLES.get(session, table_id)
    lock_device(session, row.device_id)
    pointer = active(session, row.device_id)
    if pointer is not None and pointer.table_id == row.id:
        move_pointer(session, row.device_id, Target(pointer.calibration_id))
    return row


def delete_table(session: Session, table_id: str) -> None:
    """Delete a table that was never used.

    Raises:
        UnknownCorrectionTable.
        CorrectionTableInUse: it was active once, or is, or reconstructions name it.
    """
    row = TABLES.get(session, table_id)
    lock_device(session, row.device_id)
    advice = "only a table that nothing names can be deleted; deactivate it to use it no more"
    refuse_if_referred(
        session,
        CorrectionTableInUse,
        row,
        advice,
        {
            "activations": (ActivationRow, ActivationRow.table_id == row.id),
            "reconstructions": (ReconstructionRow, ReconstructionRow.table_id == row.id),
            "quality checks": (QualityCheckRow, QualityCheckRow.table_id == row.id),
        },
    )
    session.delete(row)
    session.flush()


def active_calibration(session: Session, device_id: str) -> ActiveCalibration:
    """Return the calibration and the table that the device's pointer names, with their content."""
    pointer = active(session, device_id)
    if pointer is None:
        return ActiveCalibration()
    return stored_calibration(session, pointer.calibration_id, pointer.table_id)


def stored_calibration(
    session: Session,
    calibration_id: str | None,
    table_id: str | None,
    radiometric: ActiveRadiometric | None = None,
) -> ActiveCalibration:
    """Return a calibration and a table by their ids, with their content."""
    if calibration_id is None:
        return ActiveCalibration(radiometric=radiometric)
    calibration = CALIBRATIONS.get(session, calibration_id)
    table = None if table_id is None else TABLES.get(session, table_id)
    return ActiveCalibration(
        calibration.id,
        result_of(calibration.content),
        table_id,
        content_of(table).table if table else None,
        calibration.content,
        calibration.content_hash,
        table.data if table else None,
        radiometric,
    )


def document(session: Session, row: CorrectionTableRow) -> CorrectionTableDocument:
    """Return the table as clients see it, without its numbers."""
    pointer = active(session, row.device_id)
    in_use = pointer is not None and pointer.table_id == row.id
    return from_attributes(CorrectionTableDocument, row, active=in_use, **row.content)
