"""Check that the triggers that keep rows immutable are present and unaltered."""

import re
from collections.abc import Iterator
from typing import Final

from sqlalchemy import Connection, text

from migrations.versions import v0004_keys_audit, v0006_guards, v0008_tools, v0012_radiometric

_REVISIONS_WITH_TRIGGERS: Final = (v0004_keys_audit, v0006_guards, v0008_tools, v0012_radiometric)
"""The revisions that make them; a later one that makes others belongs here, too."""

_POSTGRESQL_TRIGGERS: Final = text(
    "SELECT tgname, pg_get_triggerdef(t.oid, true), tgenabled IN ('O', 'A') FROM pg_trigger t "
    "JOIN pg_class c ON tgrelid = c.oid "
    "WHERE NOT tgisinternal AND relnamespace = current_schema()::regnamespace"
)
_POSTGRESQL_FUNCTIONS: Final = text(
    "SELECT proname, prosrc, true FROM pg_proc WHERE pronamespace = current_schema()::regnamespace"
)
_SQLITE_TRIGGERS: Final = text("SELECT name, sql, 1 FROM sqlite_master WHERE type = 'trigger'")

_NAME: Final = re.compile(r"CREATE (?:OR REPLACE )?(TRIGGER|FUNCTION) (\w+)")


def missing_triggers(connection: Connection) -> Iterator[str]:
    """Yield what is missing, altered or switched off, by which immutable rows could be changed."""
    sqlite = connection.dialect.name == "sqlite"
    triggers = {}
    for query in [_SQLITE_TRIGGERS] if sqlite else [_POSTGRESQL_TRIGGERS, _POSTGRESQL_FUNCTIONS]:
        for name, definition, enabled in connection.execute(query):
            triggers[name] = (_normalise_sql(definition), enabled)
    for (kind, name), definition in sorted(_expected_triggers(connection.dialect.name).items()):
        if name not in triggers:
            yield f"the {kind} {name} is missing: what is immutable could be changed"
        elif triggers[name][0] != definition:
            yield f"the {kind} {name} is not what it was: what is immutable could be changed"
        elif not triggers[name][1]:
            yield f"the {kind} {name} is switched off: what is immutable could be changed"


def _expected_triggers(dialect: str) -> dict[tuple[str, str], str]:
    """Return what every trigger and function of a new database says, by kind and name."""
    expected = {}
    for revision in _REVISIONS_WITH_TRIGGERS:
        for statement in revision.guards(dialect):
            match = _NAME.match(statement)
            assert match is not None, statement
            kind, name = match[1].lower(), match[2]
            # Of a function the database tells what stands between the dollars.
            body = statement.split("$$")[1] if kind == "function" else statement
            # The driver takes %% for one of them.
            expected[kind, name] = _normalise_sql(
                body if dialect == "sqlite" else body.replace("%%", "%")
            )
    return expected


def _normalise_sql(definition: str) -> str:
    """Return a definition without what PostgreSQL writes in its own way."""
    return re.sub(r"[\s()]", "", definition).lower()
