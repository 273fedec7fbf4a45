"""Scopes, the principal who makes a request, and the act that the audit log records."""

from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final, Literal, get_args

Scope = Literal[
    "read:stream",
    "read:calibration",
    "read:audit",
    "operate:holds",
    "operate:devices",
    "operate:recordings",
    "operate:checks",
    "write:tools",
    "write:registrations",
    "write:holds",
    "write:calibrations",
    "write:recordings",
    "write:results",
    "activate:calibrations",
    "admin:devices",
    "admin:webhooks",
    "admin:keys",
]
"""Scopes by what their misuse can break; none includes another."""
SCOPES: Final[tuple[Scope, ...]] = get_args(Scope)

SCOPE_MEANINGS: Final[Mapping[Scope, str]] = {
    "read:stream": "measure: devices and their state, the stream, tools and their poses, beam "
    "holds, points from posted readings",
    "read:calibration": "read calibrations, reports, tables, captures, checks, runs and history",
    "read:audit": "read the audit log and the newest lines of the server's log",
    "operate:holds": "acknowledge beam holds, and set or remove their references",
    "operate:devices": "start and stop devices",
    "operate:recordings": "start and stop recordings",
    "operate:checks": "measure quality checks and drift checks",
    "write:tools": "make, change, pivot and delete tools",
    "write:registrations": "make and delete registrations",
    "write:holds": "make, change and delete beam holds",
    "write:calibrations": "make calibrations, correction tables, captures and runs of these, and "
    "delete what is not active; set the watch of a device, and delete quality checks",
    "write:recordings": "delete recordings",
    "write:results": "make and delete exports, cancel and delete runs, delete reconstructions",
    "activate:calibrations": "activate, deactivate, roll back and retire calibrations and tables",
    "admin:devices": "create, change and delete devices",
    "admin:webhooks": "make, change, test and delete webhooks",
    "admin:keys": "make keys of any scope, and revoke keys",
}

SCOPE_RISKS: Final[Mapping[Scope, str]] = {
    "read:stream": "nothing is changed; what is measured is seen",
    "read:calibration": "nothing is changed",
    "read:audit": "nothing is changed; who did what, and from where, is seen",
    "operate:holds": "a beam is enabled now although the patient is not where they should be; the "
    "limits stay",
    "operate:devices": "measurement stops, and beams are held; it starts again with the same "
    "settings",
    "operate:recordings": "data are not recorded, or the disk fills",
    "operate:checks": "a wrong check is stored, and alarms or hides an alarm",
    "write:tools": "poses of a tool, or its tip, are wrong",
    "write:registrations": "poses in a registered frame are wrong",
    "write:holds": "a beam is enabled beyond its limits, in every later session too",
    "write:calibrations": "a wrong calibration is stored, which nothing uses until it is "
    "activated; processor time and room are used up; warnings of drift stop",
    "write:recordings": "recorded data are lost",
    "write:results": "computed results are lost and must be computed again; the disk fills",
    "activate:calibrations": "everything that a device measures is wrong",
    "admin:devices": "a device measures nothing or something else; what belongs to it is deleted "
    "with it",
    "admin:webhooks": "alarms go nowhere or to somebody else, who sees them; the server sends "
    "requests into its network",
    "admin:keys": "anything: a key with every scope",
}
"""What goes wrong when a scope is in the wrong hands."""


def known_scopes(names: set[str]) -> frozenset[Scope]:
    """Return those of the names that are scopes."""
    return frozenset(scope for scope in SCOPES if scope in names)


Kind = Literal["key", "token", "local", "command", "service"]


@dataclass(frozen=True)
class Principal:
    """Caller of a request, or a program that acts without one, with its scopes.

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
