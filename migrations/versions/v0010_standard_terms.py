"""Members of stored documents take the names of the field's standard terms.

A calibration's document is hashed, and a correction table names that hash: where a document
changes, its hash, the tables' parent hash and the tables' own hash are worked out again. Documents
without a renamed member, and the audit log, stay as they are. The settings of the thesis's trackers
leave the devices, which do not track by them any more.
"""

import hashlib
import io
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

import h5py
import numpy as np
import sqlalchemy as sa
from alembic import op

from migrations.versions import v0004_keys_audit, v0006_guards, v0008_tools

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

Names = dict[str, str]

_CALIBRATION: Final[Names] = {
    "smaller": "reduced_terms",
    "weakest_in_words": "weakest_description",
    "off_px": "residual_px",
    "off_sigma": "normalised_residual",
}
"""Members of ``content.result`` of a calibration."""

_LABEL_KINDS: Final[Names] = {"wrong": "outlier", "missing": "wrong-label"}
"""Kinds of ``content.result.labels`` of a calibration."""

_REMOVED: Final = frozenset({"iteration_change_px", "derived"})
"""Members of ``content.result`` that were removed, and so was ``settings.method``: the thesis's
methods are no setting any more. All had defaults: a downgrade need not restore them."""

_DOCUMENTS: Final[dict[tuple[str, str], tuple[Names, Names]]] = {
    ("devices", "tracking"): (
        {
            "white_acceleration": "acceleration_psd",
            "white_jerk": "jerk_psd",
            "tool_turn_acceleration_rad_s2": "tool_angular_acceleration_rad_s2",
            "low": "off_level",
            "missed": "miss_probability",
        },
        {},
    ),
    ("runs", "request"): (
        {
            "smoothness": "penalty_weight",
            "near_points": "min_neighbours",
            "subject": "target",
            "most_tip_sd_mm": "max_tip_sd_mm",
        },
        {},
    ),
    ("drift_checks", "result"): (
        {
            "degrees_of_freedom": "dof",
            "as_a_whole": "rigid_motion",
            "turned_rad": "rotation_rad",
            "shifted_mm": "translation_mm",
            "meaning": "description",
            "p_value_explained": "p_value_with_change",
        },
        {},
    ),
    ("reconstructions", "estimates"): ({}, {"doubtful-peak": "suspect-peak"}),
    ("tool_calibrations", "result"): (
        {"outlying": "outliers", "swing_deg": "smallest_rotation_deg"},
        {},
    ),
    ("registrations", "asked"): (
        {
            "most_rms_mm": "max_rms_mm",
            "start_turn_deg": "initial_rotation_tolerance_deg",
            "start_shift_mm": "initial_shift_tolerance_mm",
            "places": "vertices",
        },
        {},
    ),
    ("registrations", "result"): (
        {
            "steps": "iterations",
            "hold": "stiffness_ratio",
            "weakest": "weakest_motion",
            "turned_deg": "rotation_deg",
            "shifted_mm": "shift_mm",
            "other": "alternative",
        },
        {},
    ),
    ("holds", "watch"): (
        {"least_markers": "min_markers", "near_mm": "search_radius_mm", "seen_as": "observed_as"},
        {"lit-markers": "simultaneous-markers"},
    ),
    ("holds", "limits"): ({"turn_rad": "rotation_rad", "chance": "probability"}, {}),
    ("holds", "rules"): ({"most_gap_s": "max_gap_s"}, {}),
    ("holds", "reference"): ({"places_mm": "positions_mm", "taken_at": "set_at"}, {}),
}
"""By table and column: members renamed at any depth, and texts that are values."""

_TRACKERS_OF_THE_THESIS: Final = frozenset(
    {
        "method", "window_markers", "window_points", "window_decision", "velocity_limit_px_s",
        "most_velocity_px_s", "interval_velocity", "least_interval_px", "exchange_threshold",
    }
)  # fmt: skip
"""Members of ``devices.tracking`` that are dropped: such a device is tracked on its readings."""

_NAMED_BY_USERS: Final = frozenset({"readings", "sigma_px", "observed_as", "seen_as"})
"""Members whose own members are names that users gave: they stay."""

_ARRAYS: Final = {"coefficients_px": "<f8", "variance_px2": "<f8", "valid": "u1"}
"""Datasets of a correction table's file, in the order in which they are hashed."""


def upgrade() -> None:
    _drop_trackers()
    _rename(lambda names: names)


def downgrade() -> None:
    _rename(lambda names: {new: old for old, new in names.items()})


def _drop_trackers() -> None:
    bind = op.get_bind()
    rows = sa.Table("devices", sa.MetaData(), autoload_with=bind)
    for key, tracking in bind.execute(sa.select(rows.c.id, rows.c.tracking)).all():
        if tracking and not _TRACKERS_OF_THE_THESIS.isdisjoint(tracking):
            kept = {
                name: value
                for name, value in tracking.items()
                if name not in _TRACKERS_OF_THE_THESIS
            }
            bind.execute(rows.update().where(rows.c.id == key).values(tracking=kept or sa.null()))


def _rename(direction: Callable[[Names], Names]) -> None:
    bind = op.get_bind()
    tables = sa.MetaData()
    with _unguarded(bind):
        for (table, column), (members, values) in _DOCUMENTS.items():
            _rename_column(bind, tables, table, column, direction(members), direction(values))
        _rename_calibrations(bind, tables, direction(_CALIBRATION), direction(_LABEL_KINDS))
        _remove_method_of_runs(bind, tables)


def _rename_column(
    bind: sa.Connection, tables: sa.MetaData, table: str, column: str, members: Names, values: Names
) -> None:
    rows = sa.Table(table, tables, autoload_with=bind)
    for key, document in bind.execute(sa.select(rows.c.id, rows.c[column])).all():
        renamed = _renamed(document, members, values)
        if renamed != document:
            bind.execute(rows.update().where(rows.c.id == key).values({column: renamed}))


def _rename_calibrations(
    bind: sa.Connection, tables: sa.MetaData, members: Names, kinds: Names
) -> None:
    rows = sa.Table("calibrations", tables, autoload_with=bind)
    for key, content in bind.execute(sa.select(rows.c.id, rows.c.content)).all():
        if not isinstance(content, dict) or "result" not in content:
            continue
        result = _without_removed(_renamed(content["result"], members, {}))
        for finding in result.get("labels", []):
            finding["kind"] = kinds.get(finding["kind"], finding["kind"])
        if result == content["result"]:
            continue
        changed = content | {"result": result}
        digest = hashlib.sha256(_canonical(changed)).hexdigest()
        bind.execute(
            rows.update().where(rows.c.id == key).values(content=changed, content_hash=digest)
        )
        _rename_parent(bind, sa.Table("correction_tables", tables, autoload_with=bind), key, digest)


def _without_removed(result: dict[str, Any]) -> dict[str, Any]:
    """Return a calibration's result without the members that were removed."""
    kept: dict[str, Any] = _pruned(result)
    if isinstance(kept.get("settings"), dict):
        kept["settings"] = {k: v for k, v in kept["settings"].items() if k != "method"}
    return kept


def _pruned(document: Any) -> Any:
    if isinstance(document, dict):
        return {name: _pruned(value) for name, value in document.items() if name not in _REMOVED}
    return [_pruned(value) for value in document] if isinstance(document, list) else document


def _remove_method_of_runs(bind: sa.Connection, tables: sa.MetaData) -> None:
    """Remove the method from requests of calibration runs, which know one method."""
    rows = sa.Table("runs", tables, autoload_with=bind)
    query = sa.select(rows.c.id, rows.c.request).where(rows.c.kind == "calibration")
    for key, request in bind.execute(query).all():
        if isinstance(request, dict) and "method" in request:
            rest = {name: value for name, value in request.items() if name != "method"}
            bind.execute(rows.update().where(rows.c.id == key).values(request=rest))


def _rename_parent(bind: sa.Connection, rows: sa.Table, calibration: str, digest: str) -> None:
    """Let the tables of a calibration name its new hash."""
    query = sa.select(rows.c.id, rows.c.content, rows.c.data)
    for key, content, data in bind.execute(query.where(rows.c.calibration_id == calibration)).all():
        file, own = _with_parent(data, digest)
        header = content | {"calibration_hash": digest}
        bind.execute(
            rows.update()
            .where(rows.c.id == key)
            .values(calibration_hash=digest, content_hash=own, content=header, data=file)
        )


def _with_parent(data: bytes, calibration_hash: str) -> tuple[bytes, str]:
    """Return a table's file with another parent, and the file's content hash."""
    buffer = io.BytesIO(data)
    with h5py.File(buffer, "r+") as file:
        attributes = file.attrs
        attributes["calibration_hash"] = calibration_hash
        header = {
            "device": attributes["device"],
            "sensors": list(attributes["sensors"]),
            "calibration_hash": calibration_hash,
            "grid": {
                "origin_mm": [float(value) for value in attributes["origin_mm"]],
                "pitch_mm": [float(value) for value in attributes["pitch_mm"]],
                "cells": [int(count) for count in attributes["cells"]],
            },
            "degree": int(attributes["degree"]),
            "made_at": attributes["made_at"],
            "settings": json.loads(attributes["settings"]),
            "validation": json.loads(attributes["validation"]),
        }
        digest = hashlib.sha256(_canonical(header))
        digest.update(b"\0")
        for name, kind in _ARRAYS.items():
            digest.update(np.ascontiguousarray(file[name][()], dtype=kind).tobytes())
        attributes["content_hash"] = digest.hexdigest()
    return buffer.getvalue(), digest.hexdigest()


def _canonical(document: Any) -> bytes:
    return json.dumps(
        document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    ).encode()


def _renamed(document: Any, members: Names, values: Names) -> Any:
    """Return a JSON document with other names of members, and of texts that are values."""
    if isinstance(document, dict):
        return {
            members.get(name, name): value
            if name in _NAMED_BY_USERS
            else _renamed(value, members, values)
            for name, value in document.items()
        }
    if isinstance(document, list):
        return [_renamed(value, members, values) for value in document]
    return values.get(document, document) if isinstance(document, str) else document


@contextmanager
def _unguarded(bind: sa.Connection) -> Iterator[None]:
    """Take the triggers that refuse changes away meanwhile; the transaction is one."""
    sqlite = bind.dialect.name == "sqlite"
    guards = [
        statement
        for made in (v0004_keys_audit, v0006_guards, v0008_tools)
        for statement in made.guards(bind.dialect.name)
        if statement.startswith("CREATE TRIGGER")
    ]
    for statement in guards:
        _, _, name, *_ = statement.split()
        table = statement.split(" ON ")[1].split()[0]
        bind.exec_driver_sql(f"DROP TRIGGER {name}" + ("" if sqlite else f" ON {table}"))
    yield
    for statement in guards:
        bind.exec_driver_sql(statement)
