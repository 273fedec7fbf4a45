"""Documents stored before revision 0015 are read after it: references, durations."""

from datetime import UTC, datetime
from typing import Any

from alembic import command
from sqlalchemy import text
from sqlalchemy.orm import Session

from migrations.versions.v0015_references import _DOCUMENTS
from service.api.beam_holds.schema import BeamHold
from service.api.beam_holds.store import document as hold_document
from service.api.tools.registrations import document as registration_document
from service.api.tools.store import document as tool_document
from service.database.engine import Database
from service.database.migration import alembic_config
from service.database.models import DeviceRow, HoldRow, RegistrationRow, RunRow, ToolRow

NOW = datetime(2024, 2, 29, 12, 0, tzinfo=UTC)
MADE_WITH = {"calibration_id": "sim-nominal", "table_id": None}
OWN: dict[str, Any] = {"device_id": "sim", "note": "", "created_at": NOW}
TITLED = OWN | {"title": "patient", "updated_at": NOW}
REFERENCE = {
    "id": "reference-1", "kind": "given", **MADE_WITH, "rotation": None, "translation_mm": None,
    "covariance": None, "positions_mm": [[0.0, 0.0, 1000.0]], "covariances_mm2": None,
    "frames": None, "scatter_mm": None, "set_at": NOW.isoformat(),
}  # fmt: skip
FIDUCIALS = [
    {"name": name, "frame_mm": place, "measured_mm": place, "measured_covariance_mm2": None}
    for name, place in (("a", [0.0, 0.0, 0.0]), ("b", [9.0, 0.0, 0.0]), ("c", [0.0, 9.0, 0.0]))
]
ASKED = {
    "kind": "paired-points", "id": "image", "device_id": "sim", "reference_id": "patient",
    "fiducials": FIDUCIALS, "targets": [], "frame_sigma_mm": None, "measured_sigma_mm": None,
}  # fmt: skip
RESULT = {
    **MADE_WITH, "parent_id": "skin", "parent_created_at": NOW.isoformat(),
    "matrix": [[1.0, 0.0, 0.0, 0.0]] * 4, "covariance": [[0.0] * 6] * 6, "targets": [],
    "warnings": [],
}  # fmt: skip


def add_rows(session: Session) -> None:
    session.get_one(DeviceRow, "sim").source = {
        "kind": "replay", "recording_id": "bench.h5", "speed": 1.0
    }  # fmt: skip
    session.add(
        ToolRow(
            id="patient", **TITLED, markers_mm=[[0.0, 0.0, 0.0]] * 3, strobe_markers=None,
            tip={"position_mm": None, "tool_calibration_id": "pivot-1"}, reference_id=None,
            limits={}, origin={"kind": "captured", **MADE_WITH},
        )
    )  # fmt: skip
    session.flush()
    session.add(
        HoldRow(
            id="chest", **TITLED, tool_id="patient", limits={"shift_mm": 1.0}, rules={},
            watch={"kind": "tool", "tool_id": "patient"}, reference=REFERENCE,
        )
    )  # fmt: skip
    session.add(
        RegistrationRow(
            id="image", **OWN, reference_id="patient", asked=ASKED, result=RESULT,
        )
    )  # fmt: skip
    session.add(
        RunRow(
            id="run-1", device_id="sim", created_at=NOW, kind="update", state="queued",
            progress=0.0, stage="", request={"drift_check_id": "drift-1", "capture_id": None},
        )
    )  # fmt: skip


def documents(database: Database) -> list[Any]:
    with Session(database.engine) as session:
        return [
            session.get_one(DeviceRow, "sim").source,
            session.get_one(RunRow, "run-1").request,
            tool_document(session.get_one(ToolRow, "patient")),
            hold_document(session.get_one(HoldRow, "chest")),
            registration_document(session.get_one(RegistrationRow, "image")),
        ]


def stored(database: Database) -> str:
    with database.engine.connect() as connection:
        return "".join(
            str(row[0])
            for table, column in _DOCUMENTS
            for row in connection.execute(text(f"SELECT {column} FROM {table}"))
        ).replace("'", '"')


def test_references_of_before_are_read_after_it(database: Database) -> None:
    with Session(database.engine) as session:
        add_rows(session)
        session.commit()
    made = documents(database)
    assert isinstance(made[3], BeamHold)
    assert made[2].tip.tool_calibration_id == "pivot-1"
    with database.engine.begin() as connection:
        command.downgrade(alembic_config(connection), "0014")
    before = stored(database)
    for old in ("recording", "calibration", "tool", "reference", "parent", "drift_check"):
        assert f'"{old}":' in before
        assert f'"{old}_id":' not in before
    with database.engine.begin() as connection:
        command.upgrade(alembic_config(connection), "head")
    assert documents(database) == made
