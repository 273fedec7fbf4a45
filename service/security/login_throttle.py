"""LoginThrottle: limits failed log-ins per address; bounded in memory."""

import ipaddress
import time
from collections.abc import Callable
from math import ceil
from threading import Lock
from typing import Final

from cachetools import LRUCache

MAX_ADDRESSES: Final = 10_000


class LoginThrottle:
    """A bucket for each address that empties with failures and fills again with time.

    Without room for another address the one that tried longest ago is forgotten.
    """

    def __init__(
        self,
        per_minute: int,
        clock: Callable[[], float] = time.monotonic,
        max_addresses: int = MAX_ADDRESSES,
    ) -> None:
        self._per_minute = per_minute
        self._clock = clock
        self._spent: LRUCache[str, tuple[float, float]] = LRUCache(max_addresses)
        self._lock = Lock()

    def wait_s(self, address: str) -> int:
        """Return how long the address has to wait before it may try again [s]; 0: not at all."""
        with self._lock:
            spent = self._current_count(network(address))
        over = spent - (self._per_minute - 1)
        return ceil(over * 60.0 / self._per_minute) if over > 0 else 0

    def failed(self, address: str) -> None:
        """Count a failure."""
        key = network(address)
        with self._lock:
            spent = self._current_count(key)
            self._spent[key] = (spent + 1.0, self._clock())

    def __len__(self) -> int:
        """Addresses that are remembered."""
        return len(self._spent)

    def _current_count(self, key: str) -> float:
        spent, at = self._spent.get(key, (0.0, 0.0))
        return max(0.0, spent - (self._clock() - at) * self._per_minute / 60.0)


def network(address: str) -> str:
    """Return what counts as one address: of IPv6 the /64, which one machine has all of."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address[:64]
    if isinstance(ip, ipaddress.IPv6Address):
        mapped = ip.ipv4_mapped
        if mapped is not None:
            return str(mapped)
        return str(ipaddress.ip_network((int(ip), 64), strict=False))
    return str(ip)
