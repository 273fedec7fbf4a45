"""Connection of one client, from its first command until it ends."""

import asyncio
import logging
from typing import Final

from service.protocols.ndi.command import CommandReader
from service.protocols.ndi.pose_feed import PoseFeed
from service.protocols.ndi.session import Session

_log = logging.getLogger(__name__)

READ_BYTES: Final = 4096
WRITE_BUFFER_BYTES: Final = 16_384
"""Replies that may wait for the client to read them; then its commands wait."""
STALLED_S: Final = 10.0
"""How long they wait until the connection is ended."""
POSE_WAIT_S: Final = 0.02
"""How long who asks again for the frame that it has waits for another, before it gets it again."""


class ClientConnection:
    """Serves a connection.

    Args:
        name: for the log.
        session: its conversation.
        feed: the poses.
        reader: what it sends.
        writer: what it gets.

    Attributes:
        session: its conversation.
        leaving: whether it was told to go.
    """

    def __init__(
        self,
        name: str,
        session: Session,
        feed: PoseFeed,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        self.session = session
        self.leaving = False
        self._name = name
        self._feed = feed
        self._reader = reader
        self._writer = writer
        self._logged = 0
        writer.transport.set_write_buffer_limits(high=WRITE_BUFFER_BYTES)

    async def serve(self) -> str:
        """Answer until the connection ends; return why it did."""
        lines = CommandReader()
        try:
            while data := await self._reader.read(READ_BYTES):
                for received in lines.feed(data):
                    if self.session.repeats(received):
                        state = self.session.state
                        await self._feed.newer(state.device, state.reported, POSE_WAIT_S)
                    self._writer.write(self.session.answer(received))
                    async with asyncio.timeout(STALLED_S):
                        await self._writer.drain()
                self._log_problems()
                # A client that never lets its commands run out lets others have their turn.
                await asyncio.sleep(0)
            # What it asked for last is still sent.
            self._writer.close()
            async with asyncio.timeout(STALLED_S):
                await self._writer.wait_closed()
        except TimeoutError:
            return f"read none of its replies for {STALLED_S:g} s"
        except OSError as error:
            return f"gone ({error})"
        finally:
            self.end()
        return "disconnected"

    def end(self) -> None:
        """End the connection at once; what the client has not read is thrown away."""
        self.leaving = True
        self._writer.transport.abort()

    def _log_problems(self) -> None:
        for text in self.session.state.problems[self._logged :]:
            _log.warning("NDI client %s: %s", self._name, text)
        self._logged = len(self.session.state.problems)
