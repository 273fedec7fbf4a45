"""Correction tables in the database: stored, read, activated with their calibration."""

import secrets
from datetime import UTC, datetime
from typing import Literal

import numpy as np
from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.store import get_calibration
from service.api.correction_tables.schema import CorrectionTableDocument
from service.api.correction_tables.table_content import TableContent, check_table
from service.api.devices.activation import Target, active, lock_device, move_pointer
from service.database.engine import insert
from service.database.models import (
    ActivationRow,
    ActiveCalibrationRow,
    CalibrationRow,
    CorrectionTableRow,
    ReconstructionRow,
)
from service.pipeline.active_calibration import ActiveCalibration
from service.problems.errors import (
    CorrectionTableExists,
    CorrectionTableInUse,
    NoActiveCalibration,
    TableOfAnotherCalibration,
    UnknownCorrectionTable,
)

Origin = Literal["run", "upload"]


def get_table(session: Session, table_id: str) -> CorrectionTableRow:
    """Return a table; raises UnknownCorrectionTable."""
    row = session.get(CorrectionTableRow, table_id)
    if row is None:
        raise UnknownCorrectionTable(
            f'there is no correction table "{table_id}"; GET /api/v1/correction-tables lists them',
            table=table_id,
        )
    return row


def tables(device_id: str | None, calibration_id: str | None) -> Select[CorrectionTableRow]:
    """Return those that the filter matches, newest first."""
    found = select(CorrectionTableRow).order_by(
        CorrectionTableRow.created_at.desc(), CorrectionTableRow.id
    )
    if device_id is not None:
        found = found.where(CorrectionTableRow.device_id == device_id)
    if calibration_id is not None:
        found = found.where(CorrectionTableRow.calibration_id == calibration_id)
    return found


def check_unused(session: Session, table_id: str | None) -> None:
    """Raise CorrectionTableExists when the id that a client chose is taken."""
    if table_id is not None and session.get(CorrectionTableRow, table_id) is not None:
        raise _exists(table_id)


def _exists(table_id: str) -> CorrectionTableExists:
    return CorrectionTableExists(
        f'correction table "{table_id}" exists already and is never overwritten; choose another '
        "id, or leave it out",
        table=table_id,
    )


def find_parent(session: Session, content: TableContent) -> CalibrationRow:
    """Return the calibration whose content has the hash that a table names.

    Of several with the same content the active one, else the newest.

    Raises:
        ForeignTable: there is none, or the table is of another device or of other sensors.
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
            calibration=rows[0].id,
            device=rows[0].device_id,
        )
    check_sensor_names(rows[0], content)
    return rows[0]


def check_sensor_names(calibration: CalibrationRow, content: TableContent) -> None:
    """Raise ForeignTable when a table's sensors are not the calibration's, in its order."""
    names = [fit["model"]["name"] for fit in calibration.content["result"]["sensors"]]
    if list(content.table.sensors) != names:
        raise TableOfAnotherCalibration(
            f"the table is of the sensors {', '.join(content.table.sensors)[:200]}, and its "
            f'calibration "{calibration.id}" of {", ".join(names)}',
            calibration=calibration.id,
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
        ForeignTable: it is of another calibration.
        InvalidParameter, TableHasHoles: see ``check_table``.
    """
    from service.api.correction_tables.hdf5_file import (
        write_table,  # the library takes a while to load
    )

    check_unused(session, table_id)
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
    insert(session, row, _exists(row.id))
    return row


def _figures(content: TableContent) -> dict[str, list[float]]:
    """Return what says at a glance how large a table's corrections are, for each sensor."""
    table = content.table
    inside = [
        np.abs(values[_valid_nodes(valid, table.degree)])
        for values, valid in zip(table.coefficients_px, table.valid, strict=True)
    ]
    return {
        "valid_share": [float(valid.mean()) for valid in table.valid],
        "max_correction_px": [float(values.max()) for values in inside],
    }


def _valid_nodes(valid: np.ndarray, degree: int) -> np.ndarray:
    """Return which coefficients a valid cell depends on."""
    touched = np.zeros(tuple(count + degree for count in valid.shape), dtype=np.bool_)
    nx, ny, nz = valid.shape
    for i in range(degree + 1):
        for j in range(degree + 1):
            for k in range(degree + 1):
                touched[i : i + nx, j : j + ny, k : k + nz] |= valid
    return touched


def content_of(row: CorrectionTableRow) -> TableContent:
    """Return a stored table."""
    from service.api.correction_tables.hdf5_file import read_table

    return read_table(row.data)


def activate_table(session: Session, table_id: str, actor: str | None = None) -> CorrectionTableRow:
    """Let the table's device use it with the active calibration, which must be its parent.

    Raises:
        UnknownCorrectionTable.
        NoActiveCalibration: the device has none.
        ForeignTable: the active calibration is another one.
    """
    row = get_table(session, table_id)
    lock_device(session, row.device_id)
    pointer = active(session, row.device_id)
    if pointer is None:
        raise NoActiveCalibration(
            f'device "{row.device_id}" has no active calibration; activate the table\'s, '
            f'"{row.calibration_id}"',
            device=row.device_id,
        )
    calibration = get_calibration(session, pointer.calibration_id)
    if calibration.content_hash != row.calibration_hash:
        raise TableOfAnotherCalibration(
            f'table "{row.id}" belongs to the calibration "{row.calibration_id}" (content hash '
            f'{row.calibration_hash[:12]}...); active is "{calibration.id}" '
            f"({calibration.content_hash[:12]}...): activate that calibration first, or a table "
            "made with this one",
            table=row.id,
            calibration=row.calibration_id,
            active_calibration=calibration.id,
        )
    move_pointer(session, row.device_id, Target(calibration.id, row.id), actor)
    return row


def deactivate_table(
    session: Session, table_id: str, actor: str | None = None
) -> CorrectionTableRow:
    """Let the table's device go on without it; one that is not active stays so.

    Raises:
        UnknownCorrectionTable.
    """
    row = get_table(session, table_id)
    lock_device(session, row.device_id)
    pointer = active(session, row.device_id)
    if pointer is not None and pointer.table_id == row.id:
        move_pointer(session, row.device_id, Target(pointer.calibration_id), actor)
    return row


def delete_table(session: Session, table_id: str) -> None:
    """Delete a table that was never used.

    Raises:
        UnknownCorrectionTable.
        CorrectionTableInUse: it was active once, or is, or reconstructions name it.
    """
    row = get_table(session, table_id)
    lock_device(session, row.device_id)
    uses = {
        name: session.scalar(
            select(func.count()).select_from(table).where(table.table_id == row.id)
        )
        or 0
        for name, table in (("activations", ActivationRow), ("reconstructions", ReconstructionRow))
    }
    if any(uses.values()):
        listed = " and ".join(f"{count} {name}" for name, count in uses.items())
        raise CorrectionTableInUse(
            f'correction table "{table_id}" is named by {listed}, which would lose what they say; '
            "only tables that were never used can be deleted",
            table=table_id,
            **uses,
        )
    session.delete(row)
    session.flush()


def active_calibration(session: Session, device_id: str) -> ActiveCalibration:
    """Return the calibration and the table that the device's pointer names, with their content."""
    pointer = active(session, device_id)
    if pointer is None:
        return ActiveCalibration()
    calibration = get_calibration(session, pointer.calibration_id)
    table = None if pointer.table_id is None else get_table(session, pointer.table_id)
    return ActiveCalibration(
        calibration.id,
        result_of(calibration.content),
        pointer.table_id,
        content_of(table).table if table else None,
        calibration.content,
        calibration.content_hash,
        table.data if table else None,
    )


def document(session: Session, row: CorrectionTableRow) -> CorrectionTableDocument:
    """Return the table as clients see it, without its numbers."""
    pointer = active(session, row.device_id)
    return CorrectionTableDocument.model_validate(
        row.content
        | {
            "id": row.id,
            "device": row.device_id,
            "calibration": row.calibration_id,
            "calibration_hash": row.calibration_hash,
            "content_hash": row.content_hash,
            "active": pointer is not None and pointer.table_id == row.id,
            "origin": row.origin,
            "note": row.note,
            "created_at": row.created_at,
        }
    )
