"""Documents stored before revision 0018 are read after it, and the chain of hashes holds."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from alembic import command
from sqlalchemy import text
from sqlalchemy.orm import Session

from compute.calibration.settings import CalibrationSettings
from service.api.calibrations.calibration_content import (
    CalibrationRecord,
    calibration_content,
    content_hash,
    result_of,
)
from service.api.calibrations.store import add_calibration
from service.api.correction_tables.hdf5_file import read_table
from service.api.correction_tables.store import add_table
from service.application.initial_content import nominal_calibration
from service.backup.consistency import find_inconsistencies
from service.database.engine import Database
from service.database.migration import alembic_config
from service.database.models import CalibrationRow, CorrectionTableRow, RunRow
from tests.service.api.correction_tables.tables import content

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
REQUEST: dict[str, Any] = {"device_id": "sim", "position_sigma_mm": 0.02}


def _stored(database: Database) -> str:
    with database.engine.connect() as connection:
        rows = [
            *connection.execute(text("SELECT content FROM calibrations")),
            *connection.execute(text("SELECT content FROM correction_tables")),
            *connection.execute(text("SELECT request FROM runs ORDER BY kind")),
        ]
    return json.dumps([str(row[0]) for row in rows])


def test_documents_of_before_have_the_new_name_and_their_hashes(database: Database) -> None:
    settings = CalibrationSettings("none", position_sigma_mm=0.02)
    result = replace(nominal_calibration(), settings=settings)
    made = CalibrationRecord(result, calibration_content("sim", "fitted", [], result), {})
    table = replace(content(made.content_hash), settings={"position_sigma_mm": 0.1, "points": 9})
    with Session(database.engine) as session:
        parent = add_calibration(session, "sim", made, "", "framed")
        add_table(session, table, parent, "run", "", "mapped")
        for kind in ("calibration", "mapping", "update"):
            session.add(
                RunRow(
                    id=kind, kind=kind, device_id="sim", request=REQUEST, state="succeeded",
                    created_at=NOW, progress=1.0, stage="",
                )
            )  # fmt: skip
        session.commit()
    new = _stored(database)
    with database.engine.begin() as connection:
        command.downgrade(alembic_config(connection), "0017")
    old = _stored(database)
    assert old.count("control_sigma_mm") == 2
    assert old.count("point_sigma_mm") == 2
    assert old.count("position_sigma_mm") == 1  # of the update, which was always called so
    with database.engine.begin() as connection:
        command.upgrade(alembic_config(connection), "head")
    assert sorted(_stored(database)) == sorted(new)
    with Session(database.engine) as session:
        row = session.get_one(CalibrationRow, "framed")
        assert result_of(row.content) == result
        assert row.content_hash == content_hash(row.content) == made.content_hash
        mapped = session.get_one(CorrectionTableRow, "mapped")
        read = read_table(mapped.data)
        assert read.settings == table.settings
        assert mapped.calibration_hash == read.table.calibration_hash == made.content_hash
        assert mapped.content_hash == read.content_hash() == table.content_hash()
    with database.engine.connect() as connection:
        assert find_inconsistencies(connection) == []
