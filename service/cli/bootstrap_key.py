"""Makes the first key of a server that requires keys, shown once on the terminal."""

import logging
import sys
from typing import Final

from service.cli.preflight import open_database
from service.principal import SCOPES, Act, Principal, current_act
from service.security import store
from service.security.credential import keys_required
from service.settings import Settings

_log = logging.getLogger(__name__)

_SERVE: Final = Principal("command", "serve", "serve", frozenset())


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
                _, made = store.add_key(session, "first key", SCOPES)
        finally:
            current_act.reset(token)
    finally:
        database.close()
    sys.stderr.write(
        f"\nClients need a key. This is the first one, of every scope; it is shown once:\n\n"
        f"    {made.text}\n\n"
        "Make others with POST /api/v1/keys, or with: lumiline keys create\n\n"
    )
