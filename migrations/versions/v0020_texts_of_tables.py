"""Files of correction tables are of format version 2: their texts have fixed lengths.

A damaged length of a text of variable length makes HDF5 loop for ever. What a table holds, and so
its hash, stays as it is.
"""

import io
from collections.abc import Callable
from typing import Any, Final

import h5py
import numpy as np
import sqlalchemy as sa
from alembic import op

from migrations.versions.v0010_standard_terms import _unguarded

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None

_VERSION: Final = "format_version"
_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"


def upgrade() -> None:
    _rewrite(_fixed, 2)


def downgrade() -> None:
    _rewrite(_variable, 1)


def _rewrite(stored: Callable[[list[str]], Any], version: int) -> None:
    bind = op.get_bind()
    rows = sa.Table("correction_tables", sa.MetaData(), autoload_with=bind)
    with _unguarded(bind):
        for key, data in bind.execute(sa.select(rows.c.id, rows.c.data)).all():
            if not data.startswith(_SIGNATURE):
                continue  # damaged; `lumiline check-database` says so
            whole = _rewritten(data, stored, version)
            bind.execute(rows.update().where(rows.c.id == key).values(data=whole))


def _rewritten(data: bytes, stored: Callable[[list[str]], Any], version: int) -> bytes:
    """Return a file with the same members, its texts stored in another way."""
    buffer = io.BytesIO()
    with (
        h5py.File(io.BytesIO(data), "r") as old,
        h5py.File(buffer, "w", libver="latest") as new,
    ):
        for name, value in old.attrs.items():
            if name == _VERSION:
                new.attrs[name] = version
            elif isinstance(value, str | bytes):
                new.attrs[name] = stored([_text(value)])[0]
            elif value.dtype.kind in "OS":
                new.attrs[name] = stored([_text(one) for one in value])
            else:
                new.attrs[name] = value
        for name in old:
            old.copy(name, new)
    return buffer.getvalue()


def _text(value: str | bytes) -> str:
    return value.decode() if isinstance(value, bytes) else value


def _fixed(texts: list[str]) -> Any:
    encoded = [text.encode() for text in texts]
    return np.array(encoded, dtype=f"S{max(1, *map(len, encoded))}")


def _variable(texts: list[str]) -> Any:
    return np.array(texts, dtype=h5py.string_dtype())
