"""Documents stored before revision 0010 are read after it, and the chain of hashes holds."""

import json
from dataclasses import replace

import numpy as np
import pytest
from alembic import command
from sqlalchemy import text
from sqlalchemy.orm import Session

from compute.calibration.assessment.assess import calibrate_and_assess
from compute.calibration.mislabels.repair import LabelFinding
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry
from compute.camera.stack import CameraStack
from compute.tracking.settings import TrackerSettings
from migrations.versions import v0010_standard_terms
from service.api.calibrations.calibration_content import (
    CalibrationRecord,
    calibration_content,
    content_hash,
    result_of,
)
from service.api.calibrations.store import add_calibration
from service.api.correction_tables.hdf5_file import read_table
from service.api.correction_tables.store import add_table
from service.api.devices.tracking_settings import Tracking
from service.application.initial_content import nominal_calibration
from service.backup.consistency import find_inconsistencies
from service.database.engine import Database
from service.database.migration import alembic_config
from service.database.models import CalibrationRow, CorrectionTableRow, DeviceRow, HoldRow
from tests.service.api.correction_tables.tables import SENSORS, content

OLD = (
    '"smaller"', '"weakest_in_words"', '"off_px"', '"off_sigma"', '"white_jerk"', '"low"',
    '"wrong"', '"missing"',
)  # fmt: skip
NEW = (
    '"reduced_terms"', '"weakest_description"', '"residual_px"', '"normalised_residual"',
    '"jerk_psd"', '"off_level"', '"outlier"', '"wrong-label"',
)  # fmt: skip


def record() -> CalibrationRecord:
    """A calibration with a distortion as of a choice among sets, a diagnosis and all findings."""
    rng = np.random.default_rng(4)
    points = rng.uniform((-300, -300, 1300), (300, 300, 1900), (60, 3))
    readings = CameraStack.of(nominal_calibration().models).project(points) + rng.normal(
        0.0, 0.05, (60, 4)
    )
    readings[[3, 9], 1] = readings[[9, 3], 1]
    sensors = [SensorGeometry(name, 2048) for name in SENSORS]
    settings = CalibrationSettings(distortion="auto", labels="repair")
    result = calibrate_and_assess(
        points, readings, sensors, np.full(readings.shape, 0.05), settings
    )
    other = (
        LabelFinding("outlier", "s1", (5,), 0.9, (3.0,), (8.0,)),
        LabelFinding("wrong-label", "s3", (7, 8), 0.9, (3.0, None), (8.0, None)),
    )
    result = replace(result, labels=result.labels + other)
    document = calibration_content("sim", "fitted", [], result)
    document["result"]["distortion"]["reduced_terms"] = []
    return CalibrationRecord(result, document, {})


def tree(database: Database) -> str:
    with database.engine.connect() as connection:
        rows = connection.execute(text("SELECT content FROM calibrations")).all()
        rows += connection.execute(text("SELECT tracking FROM devices")).all()
        return json.dumps([str(row[0]) for row in rows]).replace('\\"', '"').replace("'", '"')


@pytest.mark.slow
def test_documents_of_before_are_read_after_it_with_their_hashes(database: Database) -> None:
    tracking = Tracking.model_validate(
        {"jerk_psd": 1e7, "blinking": {"words": ["000000010111"], "off_level": 0.3}}
    ).model_dump(mode="json")
    made = record()
    with Session(database.engine) as session:
        parent = add_calibration(session, "sim", made, "", "renamed")
        add_table(session, content(made.content_hash), parent, "computed", "", "table")
        session.get_one(DeviceRow, "sim").tracking = tracking
        session.commit()
    assert all(name in tree(database) for name in NEW)
    with database.engine.begin() as connection:
        command.downgrade(alembic_config(connection), "0009")
    before = tree(database)
    assert all(name in before for name in OLD)
    assert not any(name in before for name in NEW)
    with database.engine.begin() as connection:
        command.upgrade(alembic_config(connection), "head")
    with Session(database.engine) as session:
        row = session.get_one(CalibrationRow, "renamed")
        assert result_of(row.content) == made.result
        assert row.content_hash == content_hash(row.content) == made.content_hash
        table = session.get_one(CorrectionTableRow, "table")
        read = read_table(table.data)
        assert table.calibration_hash == read.table.calibration_hash == made.content_hash
        assert table.content_hash == read.content_hash()
        assert session.get_one(DeviceRow, "sim").tracking == tracking
    with database.engine.connect() as connection:
        assert find_inconsistencies(connection) == []


@pytest.mark.slow
def test_a_device_of_a_tracker_of_the_thesis_is_tracked_on_readings(database: Database) -> None:
    stored = {
        "tracks": "always",
        "method": "window",
        "most_velocity_px_s": 600.0,
        "white_jerk": 1e7,
    }
    with database.engine.begin() as connection:
        command.downgrade(alembic_config(connection), "0009")
        connection.execute(
            text("UPDATE devices SET tracking = :tracking WHERE id = 'sim'"),
            {"tracking": json.dumps(stored)},
        )
        command.upgrade(alembic_config(connection), "head")
    with Session(database.engine) as session:
        tracking = session.get_one(DeviceRow, "sim").tracking
        assert tracking == {"tracks": "always", "jerk_psd": 1e7}
        assert Tracking.model_validate(tracking).tracker() == TrackerSettings(jerk_psd=1e7)


@pytest.mark.slow
def test_members_that_calibrations_had_before_are_removed(database: Database) -> None:
    made = record()
    with Session(database.engine) as session:
        add_calibration(session, "sim", made, "", "older")
        session.commit()
    with database.engine.begin() as connection:
        command.downgrade(alembic_config(connection), "0009")
        (stored,) = connection.execute(
            text("SELECT content FROM calibrations WHERE id = 'older'")
        ).one()
        older = json.loads(stored) if isinstance(stored, str) else stored
        older["result"]["settings"]["method"] = "metric"
        for fit in older["result"]["sensors"]:
            fit["iteration_change_px"] = None
            if fit["model"]["distortion"] is not None:
                fit["model"]["distortion"]["derived"] = False
        with v0010_standard_terms._unguarded(connection):
            connection.execute(
                text("UPDATE calibrations SET content = :content WHERE id = 'older'"),
                {"content": json.dumps(older)},
            )
        command.upgrade(alembic_config(connection), "head")
    with Session(database.engine) as session:
        row = session.get_one(CalibrationRow, "older")
        assert row.content == made.content
        assert row.content_hash == content_hash(row.content) == made.content_hash


@pytest.mark.slow
def test_a_beam_hold_of_before_is_read_after_it(database: Database) -> None:
    moment = "2026-03-01 12:00:00+00:00"
    limits = {"shift_mm": 2.0, "turn_rad": 0.02, "chance": 0.01, "release": 0.8}
    watch = {"kind": "lit-markers", "least_markers": 3, "near_mm": 5.0}
    with database.engine.begin() as connection:
        command.downgrade(alembic_config(connection), "0009")
        connection.execute(
            text(
                "INSERT INTO holds (id, device_id, title, watch, limits, rules, reference, note, "
                "created_at, updated_at) VALUES ('chest', 'sim', 'chest', :watch, :limits, :rules, "
                ":reference, '', :moment, :moment)"
            ),
            {
                "watch": json.dumps(watch),
                "limits": json.dumps(limits),
                "rules": json.dumps({"most_gap_s": 0.1}),
                "reference": json.dumps({"places_mm": [[1.0, 2.0, 3.0]], "taken_at": moment}),
                "moment": moment,
            },
        )
        command.upgrade(alembic_config(connection), "head")
    with Session(database.engine) as session:
        row = session.get_one(HoldRow, "chest")
        assert row.watch == {
            "kind": "simultaneous-markers", "min_markers": 3, "search_radius_mm": 5.0,
        }  # fmt: skip
        assert row.limits == {
            "shift_mm": 2.0, "rotation_rad": 0.02, "probability": 0.01, "release": 0.8,
        }  # fmt: skip
        assert row.rules == {"max_gap_s": 0.1}
        assert row.reference is not None
        assert set(row.reference) == {"positions_mm", "set_at"}
