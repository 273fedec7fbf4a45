"""RefusalAggregator: repeated refusals become one audit entry with a count.

The audit log is never cut, and whoever has any key could fill it with attempts.
"""

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Final

from service.principal import Act

AGGREGATION_S: Final = 60.0
"""Within which refusals of the same principal and operation are one."""
MAX_OPEN_ENTRIES: Final = 1000

RecordRepeats = Callable[[Act, int], Awaitable[None]]
"""Writes down how many more there were."""


@dataclass
class _OpenEntry:
    act: Act
    more: int = 0
    timer: asyncio.TimerHandle | None = None


class RefusalAggregator:
    """Refusals of the last minute by principal and operation; lives in the event loop.

    Without room for another the oldest is told of early.
    """

    def __init__(
        self,
        tell: RecordRepeats,
        aggregation_s: float = AGGREGATION_S,
        max_entries: int = MAX_OPEN_ENTRIES,
    ) -> None:
        self._tell = tell
        self._folded_s = aggregation_s
        self._max_entries = max_entries
        self._open: OrderedDict[tuple[str, str, str], _OpenEntry] = OrderedDict()
        self._telling: set[asyncio.Task[None]] = set()

    def __len__(self) -> int:
        """Number of open entries."""
        return len(self._open)

    def is_first(self, act: Act) -> bool:
        """Whether a refusal gets an entry of its own; repeats are counted and recorded later."""
        key = (act.principal.kind, act.principal.id, act.operation)
        entry = self._open.get(key)
        if entry is not None:
            entry.more += 1
            return False
        if len(self._open) >= self._max_entries:
            self._end(next(iter(self._open)))
        opened = self._open[key] = _OpenEntry(act)
        opened.timer = asyncio.get_running_loop().call_later(self._folded_s, self._end, key)
        return True

    async def close(self) -> None:
        """Record all counted refusals."""
        for key in list(self._open):
            self._end(key)
        while self._telling:
            await asyncio.gather(*self._telling)

    def _end(self, key: tuple[str, str, str]) -> None:
        ended = self._open.pop(key)
        if ended.timer is not None:
            ended.timer.cancel()
        if ended.more:
            task = asyncio.ensure_future(self._tell(ended.act, ended.more))
            self._telling.add(task)
            task.add_done_callback(self._telling.discard)
