"""Prepares `lumiline serve`; what is missing ends the command with one line."""

import typer
from alembic.util import CommandError
from sqlalchemy import URL
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError

from compute.errors import LumilineError
from service.application.bootstrap import prepare, trace_optics
from service.database.engine import Database
from service.problems.errors import NotReady
from service.settings import Settings

_FAILED = 1
_WRONG_SETTING = 2


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
        raise _end(f"setting device: {error.detail}", _WRONG_SETTING) from None
    finally:
        database.close()


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
    given = [url.password, *url.normalized_query.get("password", ())]
    return [secret for secret in given if secret]


def redact_password(url: URL) -> str:
    """Return a database's URL as it may be shown."""
    shown = url.difference_update_query(["password"])
    return shown.render_as_string(hide_password=True)


def _end(message: str, code: int) -> typer.Exit:
    typer.echo(f"error: {message}", err=True)
    return typer.Exit(code)
