"""Findings of label errors are outliers, exchanged or wrong labels.

A reading that was called wrong is an outlier, and one that was called missing has a wrong label.
The hashes of calibrations, and of the tables that name them, are worked out again.
"""

import hashlib

import sqlalchemy as sa
from alembic import op

from migrations.versions.v0010_standard_terms import Names, _canonical, _rename_parent, _unguarded

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

_KINDS: Names = {"wrong": "outlier", "missing": "wrong-label"}


def upgrade() -> None:
    _rename_kinds(_KINDS)


def downgrade() -> None:
    _rename_kinds({new: old for old, new in _KINDS.items()})


def _rename_kinds(kinds: Names) -> None:
    bind = op.get_bind()
    tables = sa.MetaData()
    with _unguarded(bind):
        rows = sa.Table("calibrations", tables, autoload_with=bind)
        for key, content in bind.execute(sa.select(rows.c.id, rows.c.content)).all():
            result = content.get("result") if isinstance(content, dict) else None
            if not isinstance(result, dict):
                continue
            labels = result.get("labels", [])
            if not any(finding["kind"] in kinds for finding in labels):
                continue
            renamed = [
                finding | {"kind": kinds.get(finding["kind"], finding["kind"])}
                for finding in labels
            ]
            changed = content | {"result": result | {"labels": renamed}}
            digest = hashlib.sha256(_canonical(changed)).hexdigest()
            bind.execute(
                rows.update().where(rows.c.id == key).values(content=changed, content_hash=digest)
            )
            parents = sa.Table("correction_tables", tables, autoload_with=bind)
            _rename_parent(bind, parents, key, digest)
