"""A connection to PostgreSQL that is given up when an answer does not come."""

import time
from typing import Any, Final, TypeVar

from psycopg import Connection, OperationalError
from psycopg.abc import PQGen

ANSWER_S: Final = 15.0
"""A server that hangs keeps no time limit of its own, and its host answers for it."""

_T = TypeVar("_T")


class TimeoutConnection(Connection[Any]):
    """Raises OperationalError after ANSWER_S without an answer, and is closed then."""

    def wait(self, gen: PQGen[_T], *given: Any, **named: Any) -> _T:
        """Wait for what the server answers."""
        return super().wait(self._in_time(gen), *given, **named)

    def _in_time(self, gen: PQGen[_T]) -> PQGen[_T]:
        """Pass on what is waited for; whoever waits comes back here several times a second."""
        end = time.monotonic() + ANSWER_S
        try:
            wanted = next(gen)
            while True:
                ready = yield wanted
                if not ready and time.monotonic() > end:
                    # What it would answer later belongs to nobody.
                    self.pgconn.finish()
                    raise OperationalError(
                        f"no answer for {ANSWER_S:g} s; the connection was closed"
                    )
                wanted = gen.send(ready)
        except StopIteration as done:
            result: _T = done.value
            return result
