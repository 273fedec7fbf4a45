"""Opens the service's database for commands that work without a server."""

import getpass
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from sqlalchemy.exc import SQLAlchemyError

from service.cli.output import fail
from service.cli.preflight import database_fault, open_database, redact_password
from service.cli.serve import load_settings, set_private_umask
from service.database.engine import Database
from service.principal import Act, Principal, current_act
from service.settings import Settings

DataDir = Annotated[
    Path | None, typer.Option(help="The service's data directory; left out: as `serve` takes it.")
]


@contextmanager
def local_database(data_dir: Path | None, command: str) -> Iterator[tuple[Database, Settings]]:
    """Yield the database of the settings; its failures end the command.

    What the command changes is in the audit log as the doing of this user.
    """
    set_private_umask()
    settings = load_settings(data_dir=data_dir)
    database = open_database(settings.effective_database_url)
    user = _user()
    token = current_act.set(
        Act(Principal("command", user, user, frozenset()), f"lumiline {command}")
    )
    try:
        yield database, settings
    except SQLAlchemyError as error:
        name = redact_password(database.engine.url)
        raise fail(f"database {name}: {database_fault(error, database.engine.url)}") from None
    except OSError as error:
        raise fail(str(error)) from None
    finally:
        current_act.reset(token)
        database.close()


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no name for the number, as in containers
        return "unknown"
