"""Authenticator: the principal of a key or token; KeyCache: keys that were valid recently."""

import hmac
import logging
import time
from collections.abc import Callable
from datetime import UTC, datetime
from threading import Lock
from typing import TYPE_CHECKING, Final

from cachetools import TTLCache

from service.database.engine import Database
from service.database.models import ApiKeyRow
from service.principal import Principal
from service.problems.errors import NotReady, TooManyAttempts, Unauthenticated
from service.security import store
from service.security.login_throttle import LoginThrottle, SharedLoginThrottle
from service.security.store import PREFIX, digest, key_id_of
from service.settings import Settings

CACHE_LIFETIME_S: Final = 600.0
"""How long after the database last said so a key is still believed."""
MAX_CACHED_KEYS: Final = 1000


class KeyCache:
    """By id: digest and principal, for CACHE_LIFETIME_S from the last validation.

    Without room for another the one that was used longest ago is forgotten. Thread-safe.
    """

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, max_entries: int = MAX_CACHED_KEYS
    ) -> None:
        self._entries: TTLCache[str, tuple[str, Principal]] = TTLCache(
            max_entries, CACHE_LIFETIME_S, clock
        )
        self._lock = Lock()

    def __len__(self) -> int:
        """Keys that are remembered."""
        with self._lock:
            return len(self._entries)

    def valid(self, key_id: str, digest: str, principal: Principal) -> None:
        """Remember a key that the database has, with this digest, and that is valid."""
        with self._lock:
            self._entries[key_id] = (digest, principal)

    def forget(self, key_id: str) -> None:
        """Forget a key that is not valid any more."""
        with self._lock:
            self._entries.pop(key_id, None)

    def principal(self, key_id: str, digest: str) -> Principal | None:
        """Return the principal of a cached key, None when there is none; check its expiry, too."""
        with self._lock:
            stored, principal = self._entries.get(key_id, ("", None))
        return principal if hmac.compare_digest(stored, digest) else None


if TYPE_CHECKING:
    from service.security.oidc import OidcTokens

_log = logging.getLogger(__name__)

_NO_DIGEST = "0" * 64


class Authenticator:
    """Checks keys against the database and tokens against the identity provider's keys."""

    def __init__(self, database: Database, settings: Settings) -> None:
        self._database = database
        limit = settings.failed_logins_per_minute
        shared = database.engine.dialect.name == "postgresql"
        self.attempts = SharedLoginThrottle(limit, database) if shared else LoginThrottle(limit)
        self.failed_logins = 0
        """Keys and tokens that were not valid, those that had to wait included."""
        self.remembered = KeyCache()
        """So that devices can be stopped while the database does not answer."""
        self._tokens = _oidc_tokens(settings)

    def principal(self, credential: str, address: str) -> Principal:
        """Return the principal of a key or token that came from an address; blocks.

        Raises:
            Unauthenticated: it is not valid; the message does not repeat it.
            TooManyAttempts: too many of this address were not.
            NotReady: the database or the identity provider does not answer.
        """
        try:
            if credential.startswith(PREFIX) or self._tokens is None:
                return self._of_key(credential)
            return self._tokens.principal(credential)
        except Unauthenticated as error:
            self.failed_logins += 1
            # Only now: others at the same address, behind a router or proxy, have valid keys, and
            # what is random to 256 bits needs no protection from being tried out.
            wait_s = self.attempts.wait_s(address)
            if wait_s:
                raise TooManyAttempts(
                    f"too many requests from {address} came with keys that are not valid; try "
                    f"again in {wait_s} s, or with a valid one",
                    retry_after_s=wait_s,
                ) from error
            self.attempts.failed(address)
            _log.warning("refused a log-in from %s: %s", address, error.detail)
            raise

    def why_ended(self, principal: Principal) -> str | None:
        """Return why a principal may not go on, None while it may; blocks. Raises NotReady."""
        if principal.expires_at is not None and principal.expires_at <= datetime.now(UTC):
            return f"the {principal.kind} has expired"
        if principal.kind == "key":
            with self._database.read() as session:
                row = session.get(ApiKeyRow, principal.id)
                state = "revoked" if row is None else store.state_of(row)
            if state != "valid":
                self.remembered.forget(principal.id)
                return f"the key was {state}" if state == "revoked" else "the key has expired"
        return None

    def _of_key(self, credential: str) -> Principal:
        identity = key_id_of(credential)
        if identity is None:
            raise Unauthenticated(
                "the key has not the form of one: lumi_, 12 letters and digits, _, and 43 more; "
                "copy it whole"
            )
        key_digest = digest(credential)
        try:
            principal, last = self._stored(identity, key_digest)
        except NotReady:
            remembered = self.remembered.principal(identity, key_digest)
            if remembered is None:
                raise
            _check_end(remembered)
            return remembered
        self.remembered.valid(identity, key_digest, principal)
        if last is None or datetime.now(UTC) - last > store.USED_EVERY:
            self._used(identity)
        return principal

    def _stored(self, identity: str, key_digest: str) -> tuple[Principal, datetime | None]:
        """Return a key's principal and last use from the database."""
        with self._database.read() as session:
            row = session.get(ApiKeyRow, identity)
            stored = _NO_DIGEST if row is None else row.digest
            # The same work, in the same time, whether or not there is such a key.
            right = hmac.compare_digest(stored, key_digest)
            if row is None or not right:
                if row is None:
                    self.remembered.forget(identity)
                raise Unauthenticated("the key is not valid; ask an administrator for one")
            state = store.state_of(row)
            if state != "valid":
                self.remembered.forget(identity)
                raise Unauthenticated(f'the key "{row.id}" is {state}; ask for another one')
            return store.principal_of(row), row.last_used_at

    def _used(self, identity: str) -> None:
        try:
            with self._database.write() as session:
                store.used(session, identity)
        except NotReady:
            pass  # logged there; the request itself can be served


def _check_end(principal: Principal) -> None:
    if principal.expires_at is not None and principal.expires_at <= datetime.now(UTC):
        raise Unauthenticated(f'the key "{principal.id}" is expired; ask for another one')


def _oidc_tokens(settings: Settings) -> "OidcTokens | None":
    if settings.oidc_issuer is None or settings.oidc_audience is None:
        return None
    # Only here: the library of tokens brings one of cryptography.
    from service.security.jwks import Jwks
    from service.security.oidc import OidcTokens

    keys = Jwks(settings.oidc_issuer, settings.oidc_jwks_url)
    return OidcTokens(settings.oidc_issuer, settings.oidc_audience, settings.oidc_scope_claim, keys)
