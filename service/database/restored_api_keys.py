"""API keys over a restore: one that was revoked stays so, and those that become valid are told."""

from dataclasses import dataclass
from datetime import UTC, datetime

from sqlalchemy import Connection, or_, select, update

from service.database.models import ApiKeyRow


@dataclass(frozen=True)
class KeyChanges:
    """What a restore did to keys, by their ids.

    Args:
        revoked: valid in the backup, and revoked now as they were in what was replaced.
        valid: valid now, and unknown to what was replaced.
        lost: valid in what was replaced, and not in the backup: nobody can use them any more.
    """

    revoked: tuple[str, ...] = ()
    valid: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()


@dataclass(frozen=True)
class ApiKeySnapshot:
    """The keys of a database: when each was revoked, and which are valid."""

    revoked_at: dict[str, datetime | None]
    valid: frozenset[str]


NO_KEYS = ApiKeySnapshot({}, frozenset())


def read_api_keys(connection: Connection) -> ApiKeySnapshot:
    """Return what a database knows of keys."""
    query = select(ApiKeyRow.id, ApiKeyRow.revoked_at, ApiKeyRow.expires_at)
    rows = connection.execute(query).all()
    now = datetime.now(UTC)
    return ApiKeySnapshot(
        {identity: revoked for identity, revoked, _ in rows},
        frozenset(
            identity
            for identity, revoked, expires in rows
            if revoked is None and (expires is None or expires > now)
        ),
    )


def keep_revoked(connection: Connection, before: ApiKeySnapshot) -> KeyChanges:
    """Revoke, among the restored keys, those that were revoked before; return what changed."""
    restored = read_api_keys(connection)
    for identity, moment in before.revoked_at.items():
        if moment is not None:
            earlier = or_(ApiKeyRow.revoked_at.is_(None), ApiKeyRow.revoked_at > moment)
            here = update(ApiKeyRow).where(ApiKeyRow.id == identity, earlier)
            connection.execute(here.values(revoked_at=moment))
    now = read_api_keys(connection)
    return KeyChanges(
        revoked=tuple(sorted(restored.valid - now.valid)),
        valid=tuple(sorted(now.valid - before.revoked_at.keys())),
        lost=tuple(sorted(before.valid - restored.revoked_at.keys())),
    )
