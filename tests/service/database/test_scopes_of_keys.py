"""Scopes of keys before revision 0013 are replaced; no key loses a right or gains one."""

from typing import Final

from alembic import command
from sqlalchemy import select, update

from migrations.versions.v0013_scopes import REPLACED
from service.database.engine import Database
from service.database.migration import alembic_config
from service.database.models import ApiKeyRow
from service.principal import SCOPES
from service.security import store
from service.security.operation_scopes import OPERATION_SCOPES

_FORMER_TEXT: Final = {
    "write:calibration": """
        delete-reconstruction create-tool capture-tool change-tool delete-tool
        calibrate-pivot calibrate-spin create-registration delete-registration
        create-beam-hold change-beam-hold delete-beam-hold set-beam-hold-reference
        remove-beam-hold-reference acknowledge-beam-hold create-quality-check
        delete-quality-check set-watch create-calibration activate-calibration
        retire-calibration roll-back-device create-calibration-run
        create-self-calibration-run create-mapping-run create-update-run create-export-run
        delete-export create-drift-check cancel-run delete-run create-capture capture-target
        delete-capture create-radiometric-capture capture-radiometric-frames
        delete-radiometric-capture create-radiometric-calibration
        activate-radiometric-calibration deactivate-radiometric-calibration
        upload-correction-table activate-correction-table deactivate-correction-table
        delete-correction-table
    """,
    "admin:hardware": """
        create-device change-device delete-device start-device stop-device start-recording
        stop-recording delete-recording
    """,
    "admin:keys": """
        list-keys create-key get-key revoke-key list-audit
    """,
}
FORMER: Final = {scope: frozenset(names.split()) for scope, names in _FORMER_TEXT.items()}
"""Operations that each former scope allowed, those that only read apart."""

LATER: Final = {"admin:webhooks"}
"""Scopes that came after the former ones: no former key gets them."""

CHANGED: Final = frozenset[str]().union(*FORMER.values())


def test_a_former_scope_and_its_replacement_allow_the_same() -> None:
    assert FORMER.keys() == REPLACED.keys()
    for former, scopes in REPLACED.items():
        now = {name for name, scope in OPERATION_SCOPES.items() if scope in scopes}
        assert now & CHANGED == FORMER[former] & OPERATION_SCOPES.keys(), former
    assert (
        set().union(*REPLACED.values()) | {"read:stream", "read:calibration"} == set(SCOPES) - LATER
    )


def store_scopes(database: Database, *sets: list[str]) -> list[str]:
    """Store a key for each list of scopes; return their ids."""
    ids = []
    with database.write() as session:
        for scopes in sets:
            row, made = store.add_key(session, "old", ("read:stream",))
            session.execute(update(ApiKeyRow).where(ApiKeyRow.id == row.id).values(scopes=scopes))
            ids.append(made.id)
    return ids


def scopes_of(database: Database, ids: list[str]) -> list[set[str]]:
    with database.read() as session:
        found = {row.id: set(row.scopes) for row in session.scalars(select(ApiKeyRow))}
    return [found[one] for one in ids]


def step(database: Database, direction: str, revision: str) -> None:
    with database.engine.begin() as connection:
        getattr(command, direction)(alembic_config(connection), revision)


def test_keys_of_a_former_database(database: Database) -> None:
    step(database, "downgrade", "0012")
    former = [
        ["read:stream"],
        ["read:calibration", "write:calibration"],
        ["admin:hardware", "admin:keys"],
        ["read:stream", "read:calibration", "write:calibration", "admin:hardware", "admin:keys"],
    ]
    ids = store_scopes(database, *former)
    step(database, "upgrade", "0013")
    assert scopes_of(database, ids) == [
        {"read:stream"},
        {"read:calibration", *REPLACED["write:calibration"]},
        {*REPLACED["admin:hardware"], *REPLACED["admin:keys"]},
        set(SCOPES) - LATER,
    ]
    step(database, "downgrade", "0012")
    assert scopes_of(database, ids) == [set(scopes) for scopes in former]


def test_back_again_a_key_gains_no_right(database: Database) -> None:
    ids = store_scopes(
        database, ["read:stream", "operate:holds"], ["operate:devices", *REPLACED["admin:keys"]]
    )
    step(database, "downgrade", "0012")
    assert scopes_of(database, ids) == [{"read:stream"}, {"admin:keys"}]
