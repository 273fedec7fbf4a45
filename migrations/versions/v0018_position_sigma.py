"""The standard deviation of known positions is called ``position_sigma_mm`` wherever it is stored.

It was ``control_sigma_mm`` of calibrations and ``point_sigma_mm`` of mappings. A calibration's
document is hashed, and a correction table names that hash and has one of its own: where a document
changes, these are worked out again, as in revision 0010. The audit log stays as it is.
"""

import hashlib
import io
import json
from typing import Any, Final

import h5py
import sqlalchemy as sa
from alembic import op

from migrations.versions.v0010_standard_terms import (
    Names,
    _canonical,
    _rename_parent,
    _unguarded,
    _with_parent,
)

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

_NEW: Final = "position_sigma_mm"
_OLD_BY_KIND: Final = {"calibration": "control_sigma_mm", "mapping": "point_sigma_mm"}
"""Old name, by the kind of the run."""


def upgrade() -> None:
    _rename({kind: {old: _NEW} for kind, old in _OLD_BY_KIND.items()})


def downgrade() -> None:
    _rename({kind: {_NEW: old} for kind, old in _OLD_BY_KIND.items()})


def _rename(names: dict[str, Names]) -> None:
    bind = op.get_bind()
    tables = sa.MetaData()
    with _unguarded(bind):
        _rename_runs(bind, tables, names)
        _rename_calibrations(bind, tables, names["calibration"])
        _rename_tables(bind, tables, names["mapping"])


def _rename_runs(bind: sa.Connection, tables: sa.MetaData, names: dict[str, Names]) -> None:
    rows = sa.Table("runs", tables, autoload_with=bind)
    query = sa.select(rows.c.id, rows.c.kind, rows.c.request).where(rows.c.kind.in_(list(names)))
    for key, kind, request in bind.execute(query).all():
        renamed = _renamed(request, names[kind])
        if renamed != request:
            bind.execute(rows.update().where(rows.c.id == key).values(request=renamed))


def _rename_calibrations(bind: sa.Connection, tables: sa.MetaData, names: Names) -> None:
    rows = sa.Table("calibrations", tables, autoload_with=bind)
    parents = sa.Table("correction_tables", tables, autoload_with=bind)
    for key, content in bind.execute(sa.select(rows.c.id, rows.c.content)).all():
        result = content.get("result") if isinstance(content, dict) else None
        if not isinstance(result, dict):
            continue
        settings = result.get("settings")
        renamed = _renamed(settings, names)
        if renamed == settings:
            continue
        changed = content | {"result": result | {"settings": renamed}}
        digest = hashlib.sha256(_canonical(changed)).hexdigest()
        bind.execute(
            rows.update().where(rows.c.id == key).values(content=changed, content_hash=digest)
        )
        _rename_parent(bind, parents, key, digest)


def _rename_tables(bind: sa.Connection, tables: sa.MetaData, names: Names) -> None:
    rows = sa.Table("correction_tables", tables, autoload_with=bind)
    query = sa.select(rows.c.id, rows.c.content, rows.c.data, rows.c.calibration_hash)
    for key, content, data, parent in bind.execute(query).all():
        settings = content.get("settings") if isinstance(content, dict) else None
        renamed = _renamed(settings, names)
        if renamed == settings:
            continue
        buffer = io.BytesIO(data)
        with h5py.File(buffer, "r+") as file:
            stored = json.loads(file.attrs["settings"])
            file.attrs["settings"] = _canonical(_renamed(stored, names)).decode()
        whole, own = _with_parent(buffer.getvalue(), parent)
        bind.execute(
            rows.update()
            .where(rows.c.id == key)
            .values(content=content | {"settings": renamed}, content_hash=own, data=whole)
        )


def _renamed(document: Any, names: Names) -> Any:
    if not isinstance(document, dict):
        return document
    return {names.get(name, name): value for name, value in document.items()}
