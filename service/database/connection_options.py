"""Timeouts of PostgreSQL: connecting, an unresponsive server, long statements."""

import time
from typing import Any, Final, TypeVar

from psycopg import Connection, OperationalError
from psycopg.abc import PQGen
from sqlalchemy import URL, Engine, event

from hardware.name_lookup import lookup

_DRIVER: Final = {
    "connect_timeout": "5",  # its own is two minutes, for which a request would wait
    # A host that is gone, or a network that drops what is sent, is noticed after about 15 s.
    "tcp_user_timeout": "15000",
    "keepalives": "1",
    "keepalives_idle": "10",
    "keepalives_interval": "2",
    "keepalives_count": "3",
}
_STATEMENT_MS: Final = 10_000


def timeouts(url: URL, *, statements: bool) -> dict[str, str]:
    """Return the driver's arguments for what the URL does not say itself of waiting.

    Args:
        url: of a PostgreSQL database.
        statements: whether the server is to give up statements that take long.
    """
    options = {name: value for name, value in _DRIVER.items() if name not in url.query}
    url_options = " ".join(url.normalized_query.get("options", ()))
    if statements and "statement_timeout" not in url_options:
        options["options"] = f"{url_options} -cstatement_timeout={_STATEMENT_MS}".strip()
    return options


def connect_with_timeout(engine: Engine) -> None:
    """Let what an engine's connections wait for fail when no answer comes, and close them then."""

    @event.listens_for(engine, "do_connect")
    def connect(_dialect: object, _record: object, arguments: Any, named: Any) -> object:
        check_names(named.get("host") or "")
        return TimeoutConnection.connect(*arguments, **named)


def check_names(hosts: str) -> None:
    """Look up the hosts of a URL, which the driver does without a time limit.

    Raises:
        OperationalError: of a name there was no answer in time.
    """
    for host in hosts.split(","):
        if host and not host.startswith(("/", "@")):  # folders of sockets
            try:
                lookup(host)
            except TimeoutError as error:
                raise OperationalError(str(error)) from error
            except (OSError, UnicodeError):
                continue  # the driver says it, and tries the others


ANSWER_S: Final = 15.0
"""A server that hangs keeps no time limit of its own, and its host answers for it."""

_T = TypeVar("_T")


class TimeoutConnection(Connection[Any]):
    """Raises OperationalError after ANSWER_S without an answer, and is closed then."""

    def wait(self, gen: PQGen[_T], *arguments: Any, **named: Any) -> _T:
        """Wait for what the server answers."""
        return super().wait(self._in_time(gen), *arguments, **named)

    def _in_time(self, gen: PQGen[_T]) -> PQGen[_T]:
        """Wrap psycopg's wait so that it wakes several times a second and can time out."""
        end = time.monotonic() + ANSWER_S
        try:
            wait_for = next(gen)
            while True:
                ready = yield wait_for
                if not ready and time.monotonic() > end:
                    # What it would answer later belongs to nobody.
                    self.pgconn.finish()
                    raise OperationalError(
                        f"no answer for {ANSWER_S:g} s; the connection was closed"
                    )
                wait_for = gen.send(ready)
        except StopIteration as done:
            result: _T = done.value
            return result
