"""API keys: their format, and the database, which has only the digest of their text.

A key is ``lumi_<id>_<secret>``: the id, 12 letters and digits, finds it in the database; the
secret has 43 letters and digits, 256 bits from the operating system. What is random to 256 bits
cannot be tried out, so SHA-256 keeps it as well as a slow hash of passwords would, and costs a
request nothing.
"""

import hashlib
import re
import secrets
import string
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Final, Literal

from sqlalchemy import or_, select, update
from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from service.database.engine import Resource
from service.database.models import ApiKeyRow
from service.principal import Principal, Scope, current_act, known_scopes
from service.problems.errors import UnknownKey

_ID_ALPHABET: Final = string.ascii_lowercase + string.digits
_SECRET_ALPHABET: Final = string.ascii_letters + string.digits
_ID_LENGTH: Final = 12
_SECRET_LENGTH: Final = 43

PREFIX: Final = "lumi_"
_FORM: Final = re.compile(r"lumi_([a-z0-9]{12})_[A-Za-z0-9]{43}", re.ASCII)


@dataclass(frozen=True)
class NewKey:
    """A key that was just made; ``text`` is shown once and kept nowhere."""

    id: str
    text: str = field(repr=False)

    @property
    def digest(self) -> str:
        """Digest of the key, which is stored in place of it."""
        return digest(self.text)


def make_key() -> NewKey:
    """Make a key."""
    identity = "".join(secrets.choice(_ID_ALPHABET) for _ in range(_ID_LENGTH))
    secret = "".join(secrets.choice(_SECRET_ALPHABET) for _ in range(_SECRET_LENGTH))
    return NewKey(identity, f"{PREFIX}{identity}_{secret}")


def key_id_of(text: str) -> str | None:
    """Return the id in a key's text, None when it has not the form of a key."""
    match = _FORM.fullmatch(text)
    return None if match is None else match.group(1)


def digest(text: str) -> str:
    """Return the SHA-256 of a key's text, in hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()


KeyState = Literal["valid", "expired", "revoked"]

USED_EVERY: Final = timedelta(hours=1)
"""The moment of last use is written down no more often: each is a write."""


def add_key(
    session: Session, name: str, scopes: Sequence[Scope], expires_at: datetime | None = None
) -> tuple[ApiKeyRow, NewKey]:
    """Store a new key and return it with its text, which nothing else has.

    Args:
        session: the session.
        name: who or what the key is for.
        scopes: what it may do.
        expires_at: until when it is valid; None: until it is revoked.

    Raises:
        InvalidParameter: it would have expired already.
    """
    now = datetime.now(UTC)
    if expires_at is not None and expires_at <= now:
        raise InvalidParameter(
            f"expires_at is {expires_at.isoformat()}, which has passed; give a later "
            "moment, or leave it out"
        )
    key = make_key()
    act = current_act.get()
    row = ApiKeyRow(
        id=key.id,
        name=name,
        digest=key.digest,
        scopes=sorted(set(scopes)),
        created_by=act.principal.label if act is not None else "service",
        created_at=now,
        expires_at=expires_at,
        revoked_at=None,
        last_used_at=None,
    )
    session.add(row)
    session.flush()
    return row, key


KEYS: Final = Resource(ApiKeyRow, "key", UnknownKey)


def revoke_key(session: Session, key_id: str) -> ApiKeyRow:
    """Revoke a key for good; one that is revoked stays as it is. Raises UnknownKey."""
    row = KEYS.get(session, key_id, lock=True)
    if row.revoked_at is None:
        row.revoked_at = datetime.now(UTC)
        session.flush()
    return row


def used(session: Session, key_id: str) -> None:
    """Write down that a key was used now."""
    now = datetime.now(UTC)
    session.execute(update(ApiKeyRow).where(ApiKeyRow.id == key_id).values(last_used_at=now))


def can_administer_keys(session: Session) -> bool:
    """Whether any valid key may make others."""
    now = datetime.now(UTC)
    valid = select(ApiKeyRow.scopes).where(
        ApiKeyRow.revoked_at.is_(None),
        or_(ApiKeyRow.expires_at.is_(None), ApiKeyRow.expires_at > now),
    )
    return any("admin:keys" in scopes for scopes in session.scalars(valid))


def state_of(row: ApiKeyRow) -> KeyState:
    """Return whether the key is valid, and if not, why."""
    if row.revoked_at is not None:
        return "revoked"
    if row.expires_at is not None and row.expires_at <= datetime.now(UTC):
        return "expired"
    return "valid"


def principal_of(row: ApiKeyRow) -> Principal:
    """Return the principal of a key."""
    return Principal("key", row.id, row.name, known_scopes(set(row.scopes)), row.expires_at)
