"""Scopes, the principal who makes a request, and the act that the audit log records."""

from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final, Literal, get_args

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


Kind = Literal["key", "token", "local", "command", "service"]


@dataclass(frozen=True)
class Principal:
    """Who asks.

    Args:
        kind: ``key``: an API key; ``token``: of the identity provider; ``local``: a program on
            the server's own machine, without a key; ``command``: the command line; ``service``:
            the server itself.
        id: the key's id, the token's subject, the user of the command line.
        name: for people.
        scopes: what it may do.
        expires_at: until when; None: without end.
    """

    kind: Kind
    id: str
    name: str
    scopes: frozenset[Scope]
    expires_at: datetime | None = None

    @property
    def label(self) -> str:
        """One text for histories, at most 200 characters."""
        if self.kind in ("local", "service"):
            return self.kind
        named = f" ({self.name})" if self.name and self.name != self.id else ""
        return f"{self.kind} {self.id}{named}"[:200]


LOCAL: Final = Principal("local", "local", "local", frozenset(SCOPES))
SERVICE: Final = Principal("service", "service", "service", frozenset())


@dataclass
class Act:
    """One request, or one command, that may change something.

    Args:
        principal: who acts.
        operation: the operation's id.
        request_id: of the request; also in the answer's header.
        address: where it came from.
        recorded: whether the audit log has an entry of it already.
    """

    principal: Principal
    operation: str
    request_id: str | None = None
    address: str | None = None
    recorded: bool = False

    def as_stored(self) -> dict[str, Any]:
        """Return the act as a run stores it, to attribute later work to its principal."""
        return {
            "kind": self.principal.kind,
            "id": self.principal.id,
            "name": self.principal.name,
            "operation": self.operation,
            "request_id": self.request_id,
            "address": self.address,
        }

    @classmethod
    def of_stored(cls, stored: Mapping[str, Any]) -> "Act":
        """Return the act of work that was asked for by whoever was stored; it has no scopes."""
        who = Principal(stored["kind"], stored["id"], stored["name"], frozenset())
        return cls(who, stored["operation"], stored["request_id"], stored["address"])


current_act: ContextVar[Act | None] = ContextVar("lumiline_act", default=None)
"""The act of this request; threads that endpoints run in get a copy of the context."""
