"""The table of access as docs/how-to/security.md has it."""

import re
from pathlib import Path
from typing import NamedTuple

_ROW = re.compile(
    r"^\| `([\w-]+)` \| (GET|POST|PUT|PATCH|DELETE|websocket)(.*?) \| `?([\w:]+)`? \|$"
)
_DOCUMENT = Path(__file__).parents[3] / "docs" / "how-to" / "security.md"


_TASK = re.compile(r"^\| ([\w ,]+) \| ((?:`[\w:]+`(?:, )?)+) \|$", re.MULTILINE)


class Row(NamedTuple):
    """One operation, how it is asked for, and the scope it needs."""

    operation: str
    method: str
    path: str
    scope: str


def documented() -> list[Row]:
    """Return the table's rows."""
    table = _DOCUMENT.read_text(encoding="utf-8").partition("| operation | request | scope |")[2]
    lines = table.split("\n\n")[0].splitlines()[2:]
    rows = []
    for line in lines:
        found = _ROW.match(line)
        assert found is not None, line
        operation, method, path, scope = found.groups()
        rows.append(Row(operation, method, path.strip(" ,"), scope))
    return rows


def documented_tasks() -> dict[str, frozenset[str]]:
    """Return the scopes that the guide proposes for a few tasks."""
    part = _DOCUMENT.read_text(encoding="utf-8").partition("| who | scopes |")[2]
    rows = _TASK.findall(part.split("\n\n")[0])
    return {who: frozenset(re.findall(r"`([\w:]+)`", scopes)) for who, scopes in rows}
