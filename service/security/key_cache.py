"""KeyCache: recently valid keys, used while the database does not answer."""

import hmac
import time
from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import Final

from service.principal import Principal

CACHE_LIFETIME_S: Final = 600.0
"""How long after the database last said so a key is still believed."""
MAX_CACHED_KEYS: Final = 1000


class KeyCache:
    """By id: digest, principal and time of the last validation.

    Without room for another the one that was used longest ago is forgotten. Thread-safe.
    """

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, max_entries: int = MAX_CACHED_KEYS
    ) -> None:
        self._clock = clock
        self._max_entries = max_entries
        self._found: OrderedDict[str, tuple[str, Principal, float]] = OrderedDict()
        self._lock = Lock()

    def __len__(self) -> int:
        """Keys that are remembered."""
        return len(self._found)

    def valid(self, key_id: str, digest: str, principal: Principal) -> None:
        """Remember a key that the database has, with this digest, and that is valid."""
        with self._lock:
            self._found[key_id] = (digest, principal, self._clock())
            self._found.move_to_end(key_id)
            while len(self._found) > self._max_entries:
                self._found.popitem(last=False)

    def forget(self, key_id: str) -> None:
        """Forget a key that is not valid any more."""
        with self._lock:
            self._found.pop(key_id, None)

    def principal(self, key_id: str, digest: str) -> Principal | None:
        """Return the principal of a cached key, None when there is none; check its expiry, too."""
        with self._lock:
            stored, principal, at = self._found.get(key_id, ("", None, 0.0))
        if principal is None or self._clock() - at > CACHE_LIFETIME_S:
            return None
        return principal if hmac.compare_digest(stored, digest) else None
