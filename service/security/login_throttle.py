"""LoginThrottle: limits failed log-ins per address, of one server or of all on a database."""

import ipaddress
import time
from collections.abc import Callable
from math import ceil
from threading import Lock
from typing import Final

from cachetools import LRUCache
from sqlalchemy import Double, cast, delete, func, select
from sqlalchemy.dialects.postgresql import insert

from service.database.engine import Database
from service.database.models import FailedLoginRow
from service.problems.errors import NotReady

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
        return self._wait_s(spent)

    def failed(self, address: str) -> None:
        """Count a failure."""
        key = network(address)
        with self._lock:
            spent = self._current_count(key)
            self._spent[key] = (spent + 1.0, self._clock())

    def __len__(self) -> int:
        """Addresses that are remembered."""
        return len(self._spent)

    def _wait_s(self, spent: float) -> int:
        over = spent - (self._per_minute - 1)
        return ceil(over * 60.0 / self._per_minute) if over > 0 else 0

    def _current_count(self, key: str) -> float:
        spent, at = self._spent.get(key, (0.0, 0.0))
        return max(0.0, spent - (self._clock() - at) * self._per_minute / 60.0)


class SharedLoginThrottle(LoginThrottle):
    """The same for all gateways of a PostgreSQL database, which counts what fails at any of them.

    While it does not answer each counts its own.

    Args:
        per_minute: as of ``LoginThrottle``.
        database: of all gateways.
    """

    def __init__(self, per_minute: int, database: Database) -> None:
        super().__init__(per_minute)
        self._database = database
        age_s = cast(func.extract("epoch", func.now() - FailedLoginRow.at), Double)
        self._emptied = func.greatest(0.0, FailedLoginRow.spent - per_minute / 60.0 * age_s)
        """What a stored bucket has now."""

    def wait_s(self, address: str) -> int:
        """Return how long the address has to wait before it may try again [s]; 0: not at all."""
        query = select(self._emptied).where(FailedLoginRow.network == network(address))
        try:
            with self._database.read() as session:
                spent = session.scalar(query)
        except NotReady:
            return super().wait_s(address)
        return self._wait_s(spent or 0.0)

    def failed(self, address: str) -> None:
        """Count a failure, and forget addresses whose bucket is empty."""
        super().failed(address)
        row = insert(FailedLoginRow).values(network=network(address), spent=1.0, at=func.now())
        counted = row.on_conflict_do_update(
            index_elements=["network"], set_={"spent": self._emptied + 1.0, "at": func.now()}
        )
        empty = select(FailedLoginRow.network).where(self._emptied == 0.0)
        empty = empty.with_for_update(skip_locked=True)
        try:
            with self._database.write() as session:
                session.execute(counted)
                session.execute(delete(FailedLoginRow).where(FailedLoginRow.network.in_(empty)))
        except NotReady:
            pass  # logged there, and counted here


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
