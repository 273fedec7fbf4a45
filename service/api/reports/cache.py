"""ReportCache: rendered pages and figures in memory, bounded, least recently used evicted."""

from collections import OrderedDict
from threading import Lock
from typing import Final

MAX_BYTES: Final = 64 * 1024**2
"""Of all that is kept; a report has about 1 MB."""


class ReportCache:
    """Pages and figures by key, those asked for last; may be used by threads at the same time.

    A key names all that is drawn, so nothing kept is ever out of date.

    Args:
        max_bytes: of all that is kept; what alone has more is not kept.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._kept: OrderedDict[str, bytes] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def get(self, key: str) -> bytes | None:
        """Return the rendered bytes of a key; None: not cached."""
        with self._lock:
            found = self._kept.get(key)
            if found is not None:
                self._kept.move_to_end(key)
            return found

    def keep(self, key: str, drawn: bytes) -> None:
        """Cache rendered bytes; the least recently used are evicted."""
        if len(drawn) > self._max_bytes:
            return
        with self._lock:
            before = self._kept.pop(key, b"")
            self._kept[key] = drawn
            self._bytes += len(drawn) - len(before)
            while self._bytes > self._max_bytes:
                _, oldest = self._kept.popitem(last=False)
                self._bytes -= len(oldest)
