"""ToolCache: the tools of all devices, read from the database from time to time."""

import asyncio
import logging
from collections.abc import Mapping
from contextlib import suppress
from typing import Final

from anyio.to_thread import run_sync
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from compute.errors import LumilineError
from service.api.tools.tip_limit import TipLimit, tip_limit_of
from service.database.engine import Database
from service.database.models import ToolRow

_log = logging.getLogger(__name__)

ASK_S: Final = 2.0
"""How often; which tools a device that runs has is known from its poses at once."""


class ToolCache:
    """Made and used in the event loop. While the database does not answer, what is known stays.

    Args:
        database: with the tools.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._tools: Mapping[str, Mapping[str, TipLimit]] = {}
        self._failing = False
        self._asking: asyncio.Task[None] | None = None

    def __call__(self) -> Mapping[str, Mapping[str, TipLimit]]:
        """Return the limits of tools by device and id, of devices that have any."""
        return self._tools

    async def start(self) -> None:
        """Ask, and go on asking."""
        await self.refresh()
        self._asking = asyncio.get_running_loop().create_task(self._ask())

    async def close(self) -> None:
        """Ask no longer."""
        if self._asking is not None:
            self._asking.cancel()
            with suppress(asyncio.CancelledError):
                await self._asking

    async def refresh(self) -> None:
        """Ask once."""
        try:
            self._tools = await run_sync(self._read)
        except (LumilineError, SQLAlchemyError) as error:
            if not self._failing:
                _log.warning("NDI clients: the tools are not known: %s", error)
            self._failing = True
            return
        self._failing = False

    async def _ask(self) -> None:
        while True:
            await asyncio.sleep(ASK_S)
            await self.refresh()

    def _read(self) -> Mapping[str, Mapping[str, TipLimit]]:
        found: dict[str, dict[str, TipLimit]] = {}
        with self._database.read() as session:
            for tool in session.scalars(select(ToolRow)):
                found.setdefault(tool.device_id, {})[tool.id] = tip_limit_of(session, tool)
        return found
