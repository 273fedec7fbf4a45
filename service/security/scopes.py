"""What a key or token may be allowed to do."""

from collections.abc import Mapping
from typing import Final, Literal, get_args

Scope = Literal[
    "read:stream", "read:calibration", "write:calibration", "admin:hardware", "admin:keys"
]
SCOPES: Final[tuple[Scope, ...]] = get_args(Scope)

SCOPE_MEANINGS: Final[Mapping[Scope, str]] = {
    "read:stream": "measure: devices and their state, the stream, tools and their poses, beam "
    "holds, points from posted readings",
    "read:calibration": "read calibrations, reports, tables, captures, runs and the history",
    "write:calibration": "make, activate, roll back, retire and delete what belongs to "
    "calibration; make, change and delete tools, registrations and beam holds, and acknowledge "
    "these",
    "admin:hardware": "create, change, delete, start and stop devices",
    "admin:keys": "make and revoke keys of any scope, and read the audit log",
}


def known_scopes(names: set[str]) -> frozenset[Scope]:
    """Return those of the names that are scopes."""
    return frozenset(scope for scope in SCOPES if scope in names)
