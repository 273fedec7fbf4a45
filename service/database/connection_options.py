"""How long PostgreSQL is waited for: one that is not there, does not answer, or takes too long."""

from typing import Any, Final

from sqlalchemy import URL, Engine, event

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
    found = {name: value for name, value in _DRIVER.items() if name not in url.query}
    given = " ".join(url.normalized_query.get("options", ()))
    if statements and "statement_timeout" not in given:
        found["options"] = f"{given} -cstatement_timeout={_STATEMENT_MS}".strip()
    return found


def connect_with_timeout(engine: Engine) -> None:
    """Let what an engine's connections wait for fail when no answer comes, and close them then."""

    @event.listens_for(engine, "do_connect")
    def connect(_dialect: object, _record: object, given: Any, named: Any) -> object:
        from service.database.query_timeout import TimeoutConnection  # only with PostgreSQL

        return TimeoutConnection.connect(*given, **named)
