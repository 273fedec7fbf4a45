"""`lumiline keys`: makes, lists and revokes API keys, in the database itself."""

from datetime import UTC, datetime, timedelta
from typing import Annotated, Final

import typer
from pydantic import TypeAdapter, ValidationError
from rich.markup import escape

from service.api.security.schema import ApiKey, NewApiKey, document
from service.application.initial_content import seed
from service.cli.local_database import DataDir, local_database
from service.cli.options import AsJson
from service.cli.output import console, fail, hint, make_table, print_json, spec
from service.database.migration import migrate
from service.principal import SCOPES
from service.security import store

_MAX_SHOWN: Final = 10_000
_TIME: Final = "%Y-%m-%d %H:%M"

keys = typer.Typer(
    help="Make, list and revoke API keys.", no_args_is_help=True, add_completion=False
)


def _complete_scope(incomplete: str) -> list[str]:
    """Return the scopes whose names begin so, for the shell's completion."""
    return [name for name in (*SCOPES, "all") if name.startswith(incomplete)]


@keys.command("create")
def create(
    name: Annotated[str, typer.Argument(help="Who or what it is for.")],
    scope: Annotated[
        list[str],
        typer.Option(
            autocompletion=_complete_scope,
            help=f"{', '.join(SCOPES)}; may be given several times. all: every one.",
        ),
    ],
    days: Annotated[
        float | None,
        typer.Option(min=0.001, max=36_525, help="Valid so long; left out: until revoked."),
    ] = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Make a key, and print it once: it is kept nowhere."""
    unknown = [one for one in scope if one not in (*SCOPES, "all")]
    if unknown:
        raise fail(f'there is no scope "{unknown[0]}"; there are {", ".join(SCOPES)}, and all')
    until = None if days is None else datetime.now(UTC) + timedelta(days=days)
    scopes = SCOPES if "all" in scope else tuple(scope)
    try:
        request = NewApiKey.model_validate({"name": name, "scopes": scopes, "expires_at": until})
    except ValidationError as error:
        raise fail(f"the name: {error.errors()[0]['msg']}") from None
    with local_database(data_dir, "keys create") as (database, settings):
        settings.folders.recordings.mkdir(parents=True, exist_ok=True)
        migrate(database, fill=seed)
        with database.write() as session:
            row, key = store.add_key(session, **dict(request))
            identity = row.id
    if as_json:
        print_json({"id": identity, "name": name, "scopes": scopes, "key": key.text})
        return
    hint(f"key {identity} for {escape(name)}: {', '.join(scopes)}")
    hint("It is shown once and kept nowhere:")
    # Its text, and nothing else, goes to standard output.
    typer.echo(key.text)


@keys.command("list")
def show(data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """List the keys that were given out."""
    with local_database(data_dir, "keys list") as (database, _), database.read() as session:
        newest = session.scalars(store.KEYS.newest_first().limit(_MAX_SHOWN))
        listed = [document(row) for row in newest]
    if as_json:
        typer.echo(TypeAdapter(list[ApiKey]).dump_json(listed, indent=2))
        return
    headings = ("id", "name", "state", "scopes", "made by", "expires", "last used")
    rows = (
        (key.id, key.name, key.state, " ".join(key.scopes), key.created_by,
         spec(key.expires_at, _TIME), spec(key.last_used_at, _TIME))
        for key in listed
    )  # fmt: skip
    console.print(make_table(headings, rows, texts=None))


@keys.command("revoke")
def revoke(
    key: Annotated[str, typer.Argument(help="Its id: the part between lumi_ and the secret.")],
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Take a key back for good; its open streams end within seconds."""
    with local_database(data_dir, "keys revoke") as (database, _), database.write() as session:
        store.revoke_key(session, key)
    if as_json:
        print_json({"id": key, "state": "revoked"})
    else:
        hint(f"key {escape(key)} is revoked")
