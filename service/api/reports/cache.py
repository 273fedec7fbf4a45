"""ReportCache: rendered pages and figures in memory, bounded, least recently used evicted."""

from threading import Lock
from typing import Final

from cachetools import LRUCache

MAX_BYTES: Final = 64 * 1024**2
"""Of all that is kept; a report has about 1 MB."""


class ReportCache:
    """Pages and figures by key, those asked for last; may be used by threads at the same time.

    A key names all that is drawn, so nothing kept is ever out of date.

    Args:
        max_bytes: of all that is kept; what alone has more is not kept.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._kept: LRUCache[str, bytes] = LRUCache(max_bytes, getsizeof=len)
        self._lock = Lock()

    def get(self, key: str) -> bytes | None:
        """Return the rendered bytes of a key; None: not cached."""
        with self._lock:
            return self._kept.get(key)

    def keep(self, key: str, drawn: bytes) -> None:
        """Cache rendered bytes; the least recently used are evicted."""
        if len(drawn) <= self._kept.maxsize:
            with self._lock:
                self._kept[key] = drawn
