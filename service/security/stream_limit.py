"""StreamLimit: limits the open streams of each principal."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Final

from anyio import CapacityLimiter

from service.principal import Principal
from service.problems.errors import TooManyStreams

_CHECKED_AT_ONCE: Final = 2


class StreamLimit:
    """Limit of open streams for each key, token subject, or all local programs."""

    def __init__(self, max_streams: int) -> None:
        self._max_streams = max_streams
        self._open: Counter[tuple[str, str]] = Counter()
        self._lock = Lock()
        self.checks = CapacityLimiter(_CHECKED_AT_ONCE)
        """Threads for their checks: those of requests stay free while a database hangs."""

    def __len__(self) -> int:
        """Streams that are open."""
        with self._lock:
            return self._open.total()

    @contextmanager
    def opened(self, principal: Principal) -> Iterator[None]:
        """Count a stream while it is open; raises TooManyStreams."""
        who = (principal.kind, principal.id)
        with self._lock:
            if self._open[who] >= self._max_streams:
                raise TooManyStreams(
                    f"{principal.label} has {self._max_streams} open streams, as many as it may; "
                    "close one"
                )
            self._open[who] += 1
        try:
            yield
        finally:
            with self._lock:
                self._open[who] -= 1
                if not self._open[who]:
                    del self._open[who]
