"""`lumiline keys`: makes, lists and revokes API keys, in the database itself."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import typer
from pydantic import TypeAdapter, ValidationError
from rich.table import Table

from service.api.security.schema import ApiKey, NewApiKey, document
from service.application.initial_content import seed
from service.cli.local_database import local_database
from service.cli.output import console, fail, progress_console
from service.database.engine import Database
from service.database.migration import migrate
from service.principal import SCOPES
from service.security import store

_MAX_SHOWN: Final = 10_000


def create(data_dir: Path | None, name: str, scopes: list[str], days: float | None) -> None:
    """Make a key; its text, and nothing else, goes to standard output."""
    unknown = [scope for scope in scopes if scope not in (*SCOPES, "all")]
    if unknown:
        raise fail(f'there is no scope "{unknown[0]}"; there are {", ".join(SCOPES)}, and all')
    until = None if days is None else datetime.now(UTC) + timedelta(days=days)
    wanted = SCOPES if "all" in scopes else tuple(scopes)
    try:
        request = NewApiKey.model_validate({"name": name, "scopes": wanted, "expires_at": until})
    except ValidationError as error:
        raise fail(f"the name: {error.errors()[0]['msg']}") from None
    with local_database(data_dir, "keys create") as (database, settings):
        settings.folders.recordings.mkdir(parents=True, exist_ok=True)
        migrate(database, fill=seed)
        with database.write() as session:
            row, made = store.add_key(session, **dict(request))
            identity = row.id
    progress_console.print(f"key {identity} for {name}: {', '.join(wanted)}", highlight=False)
    progress_console.print("It is shown once and kept nowhere:", highlight=False)
    typer.echo(made.text)


def show(data_dir: Path | None, *, as_json: bool) -> None:
    """Print the keys, newest first."""
    with local_database(data_dir, "keys list") as (database, _):
        found = _all(database)
    if as_json:
        typer.echo(TypeAdapter(list[ApiKey]).dump_json(found, indent=2))
        return
    table = Table()
    for heading in ("id", "name", "state", "scopes", "made by", "expires", "last used"):
        table.add_column(heading, overflow="fold")
    for key in found:
        table.add_row(
            key.id, key.name, key.state, " ".join(key.scopes), key.created_by,
            _day(key.expires_at), _day(key.last_used_at),
        )  # fmt: skip
    console.print(table)


def revoke(data_dir: Path | None, key_id: str) -> None:
    """Revoke a key."""
    with local_database(data_dir, "keys revoke") as (database, _), database.write() as session:
        store.revoke_key(session, key_id)
    progress_console.print(f"key {key_id} is revoked", highlight=False)


def _all(database: Database) -> list[ApiKey]:
    with database.read() as session:
        rows = session.scalars(store.KEYS.newest_first().limit(_MAX_SHOWN))
        return [document(row) for row in rows]


def _day(moment: datetime | None) -> str:
    return "-" if moment is None else f"{moment:%Y-%m-%d %H:%M}"
