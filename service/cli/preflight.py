"""Prepares `lumiline serve`: ports, database, first key; a fault ends it with one line."""

import errno
import logging
import socket
import sys
from typing import Final

import typer
from alembic.util import CommandError
from sqlalchemy import URL
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError

from compute.errors import LumilineError
from service.application.bootstrap import prepare, trace_optics
from service.database.engine import Database
from service.principal import SCOPES, Act, Principal, current_act
from service.problems.errors import NotReady
from service.security import store
from service.security.credential import keys_required
from service.settings import Settings

_log = logging.getLogger(__name__)

_FAILED: Final = 1
_WRONG_SETTING: Final = 2
_NOT_STARTED: Final = 3
"""As of a server that finds out later that a port is taken."""

_SERVE: Final = Principal("command", "serve", "serve", frozenset())


def check_ports(settings: Settings) -> None:
    """End the command with one line where a port cannot be had; later it would be a traceback.

    Raises:
        typer.Exit: the message was printed; code 3.
    """
    for name, host, port in (
        ("port", settings.host, settings.port),
        ("openigtlink_port", settings.openigtlink_host, settings.openigtlink_port),
        ("ndi_port", settings.ndi_host, settings.ndi_port),
    ):
        reason = _why_not(host, port) if port else None
        if reason is not None:
            message = f"setting {name}: cannot listen on {host} port {port}: {reason}"
            raise _end(message, _NOT_STARTED)


def _why_not(host: str, port: int) -> str | None:
    """Return why none of a name's addresses can be listened on, or one is taken; else None."""
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        return error.strerror or str(error)
    reasons = []
    for family, kind, protocol, _, address in addresses:
        try:
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                if family == socket.AF_INET6:
                    probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                probe.bind(address)
        except OSError as error:
            reasons.append(error.strerror or str(error))
            if error.errno == errno.EADDRINUSE:
                return "another program listens there; end it, or choose another port"
    return reasons[0] if len(reasons) == len(addresses) else None


def check_startup(settings: Settings) -> None:
    """Make ready what the service needs before it serves; it would do so itself, with tracebacks.

    Raises:
        typer.Exit: the message was printed; code 2 for a setting that means nothing, else 1.
    """
    database = open_database(settings.effective_database_url)
    name = redact_password(database.engine.url)
    try:
        named = prepare(settings, database)
        trace_optics(settings, database, named)
    except OSError as error:
        raise _end(
            f"data directory {settings.data_dir} cannot be used: {error.strerror or error}; "
            "data_dir must name a directory that can be written",
            _FAILED,
        ) from None
    except CommandError as error:
        raise _end(
            f"database {name} is not of this version of the service: {error}; use the version "
            "that wrote it, or a newer one",
            _FAILED,
        ) from None
    except (SQLAlchemyError, NotReady) as error:
        reason = database_fault(error, database.engine.url)
        raise _end(f"database {name} cannot be used: {reason}", _FAILED) from None
    except LumilineError as error:
        raise _end(f"setting profile: {error.detail}", _WRONG_SETTING) from None
    finally:
        database.close()


def create_bootstrap_key(settings: Settings) -> None:
    """Make a key of every scope when keys are required and none could make others.

    On a terminal it is printed there. Elsewhere standard error is a log, where no secret belongs:
    then the log says how to make one.
    """
    if not keys_required(settings):
        return
    database = open_database(settings.effective_database_url)
    try:
        with database.read() as session:
            if store.can_administer_keys(session):
                return
        if not sys.stderr.isatty():
            _log.warning(
                "clients need a key, and there is none that could make others; make one: lumiline "
                "keys create NAME --scope all, with the settings of this server"
            )
            return
        token = current_act.set(Act(_SERVE, "lumiline serve"))
        try:
            with database.write() as session:
                _, key = store.add_key(session, "first key", SCOPES)
        finally:
            current_act.reset(token)
    finally:
        database.close()
    sys.stderr.write(
        f"\nClients need a key. This is the first one, of every scope; it is shown once:\n\n"
        f"    {key.text}\n\n"
        "Make others with POST /api/v1/keys, or with: lumiline keys create\n\n"
    )


def database_fault(error: Exception, url: URL) -> str:
    """Return what a database's error says, in one line and without the URL's passwords."""
    reason = str(error.orig if isinstance(error, DBAPIError) else error)
    for secret in _secrets(url):
        reason = reason.replace(secret, "***")
    return "; ".join(line.strip() for line in reason.splitlines() if line.strip())


def open_database(url: str) -> Database:
    """Return the database of a URL; one that means nothing ends the command."""
    try:
        return Database(url)
    except (ArgumentError, ImportError, ValueError) as error:
        # Not the error's text, which may hold the URL.
        raise _end(
            f"setting database_url: not the URL of a database that the service can use "
            f"({type(error).__name__}); it must be sqlite:///FILE or "
            "postgresql+psycopg://USER:PASSWORD@HOST/DATABASE",
            _WRONG_SETTING,
        ) from None


def _secrets(url: URL) -> list[str]:
    passwords = [url.password, *url.normalized_query.get("password", ())]
    return [secret for secret in passwords if secret]


def redact_password(url: URL) -> str:
    """Return a database's URL as it may be shown."""
    redacted = url.difference_update_query(["password"])
    return redacted.render_as_string(hide_password=True)


def _end(message: str, code: int) -> typer.Exit:
    typer.echo(f"error: {message}", err=True)
    return typer.Exit(code)
