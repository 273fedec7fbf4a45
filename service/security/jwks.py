"""The identity provider's public keys (JWKS): fetched on demand, cached, with limits.

One thread fetches, and of the requests only that which began it waits, for a bounded time: a
provider that hangs must not hold up what needs none of it.
"""

import asyncio
import json
import logging
import time
from collections.abc import Callable
from threading import Event, Lock, Thread
from typing import Any, Final

import httpx
import jwt

from service.problems.errors import NotReady

_log = logging.getLogger(__name__)

_FETCH_S: Final = 10.0
"""Within which a document has to be there as a whole."""
_WAIT_S: Final = 5.0
"""How long the request that needs the keys first waits for them."""
_MAX_BYTES: Final = 256 * 1024
_MAX_KEYS: Final = 64
CACHE_LIFETIME_S: Final = 3600.0
"""Keys are fetched anew after this long."""
RETRY_INTERVAL_S: Final = 30.0
"""No two fetches are nearer than this, whatever key ids tokens name."""

Fetch = Callable[[str], bytes]


def fetch(url: str) -> bytes:
    """Return a document of the provider's.

    Raises:
        httpx.HTTPError, httpx.InvalidURL: there is none.
        TimeoutError: it is not there in time, however many bytes come.
        ValueError: it is too long.
    """
    return asyncio.run(_fetch(url))


async def _fetch(url: str) -> bytes:
    async with (
        # A limit for each read alone would let a byte now and then go on for ever.
        asyncio.timeout(_FETCH_S),
        httpx.AsyncClient(timeout=_FETCH_S, follow_redirects=False, trust_env=False) as client,
        client.stream("GET", url, headers={"accept": "application/json"}) as answer,
    ):
        answer.raise_for_status()
        body = b""
        async for part in answer.aiter_bytes():
            body += part
            if len(body) > _MAX_BYTES:
                raise ValueError(f"more than {_MAX_BYTES} bytes")
        return body


class Jwks:
    """Keys by their ids; an unknown id is looked up at most every ``AGAIN_S``."""

    def __init__(
        self,
        issuer: str,
        url: str | None,
        get: Fetch = fetch,
        clock: Callable[[], float] = time.monotonic,
        wait_s: float = _WAIT_S,
    ) -> None:
        self._issuer = issuer
        self._url = url
        self._get = get
        self._clock = clock
        self._wait_s = wait_s
        self._keys: dict[str, jwt.PyJWK] = {}
        self._fetched_at: float | None = None
        self._tried_at: float | None = None
        self._lock = Lock()
        self._fetching = False

    def key(self, kid: str) -> jwt.PyJWK | None:
        """Return the key of an id, None when the provider has none.

        Raises:
            NotReady: the provider has not answered yet.
        """
        begun = self._begin(kid)
        if begun is not None:
            begun.wait(self._wait_s)
        with self._lock:
            if self._fetched_at is None:
                raise NotReady(
                    "the identity provider does not answer; try again, or use a key of this server",
                    part="oidc",
                )
            return self._keys.get(kid)

    def _begin(self, kid: str) -> Event | None:
        """Start a fetch where one is due; return the event of its end, None if none is due."""
        with self._lock:
            now = self._clock()
            stale = self._fetched_at is None or now - self._fetched_at > CACHE_LIFETIME_S
            may = self._tried_at is None or now - self._tried_at >= RETRY_INTERVAL_S
            if self._fetching or not may or not (stale or kid not in self._keys):
                return None
            self._tried_at = now
            self._fetching = True
        ended = Event()
        Thread(target=self._refresh, args=(now, ended), name="oidc-keys", daemon=True).start()
        return ended

    def _refresh(self, now: float, ended: Event) -> None:
        """Fetch the keys; those of before are kept where that fails."""
        keys: dict[str, jwt.PyJWK] | None = None
        try:
            document = json.loads(self._get(self._jwks_url()))
            signing_keys = jwt.PyJWKSet.from_dict(document).keys[:_MAX_KEYS]
            # Shared secrets have no place among public keys, and would make forgery easy.
            keys = {
                key.key_id: key
                for key in signing_keys
                if key.key_id is not None and key.key_type != "oct"
            }
        except Exception as error:  # noqa: BLE001 - whatever a provider answers
            _log.error("identity provider: its keys cannot be had: %s", _kind(error))
        with self._lock:
            if keys is not None:
                self._keys, self._fetched_at = keys, now
            self._fetching = False
        ended.set()

    def _jwks_url(self) -> str:
        if self._url is None:
            address = f"{self._issuer.rstrip('/')}/.well-known/openid-configuration"
            document: Any = json.loads(self._get(address))
            if not isinstance(document, dict) or document.get("issuer") != self._issuer:
                raise ValueError("its configuration is of another issuer")
            url = document.get("jwks_uri")
            if not isinstance(url, str):
                raise ValueError("its configuration has no jwks_uri")
            if not url.startswith("https://") and not self._issuer.startswith("http://"):
                raise ValueError("its jwks_uri is not https")
            self._url = url
        return self._url


def _kind(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:300]
