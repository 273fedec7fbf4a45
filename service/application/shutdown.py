"""Graceful shutdown within a time limit: streams are closed with a reason, work is stopped."""

import asyncio
import ipaddress
import logging
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import Context
from types import FrameType
from typing import Any, Final

import uvicorn
from fastapi import FastAPI
from uvicorn.server import HANDLED_SIGNALS

_log = logging.getLogger(__name__)

STREAMS_S: Final = 2.0
"""How long clients have to take the last message and the close."""
STOP_WITHIN_S: Final = 30.0
"""After which a server that does not come to its end is ended."""
NOT_STOPPED: Final = 4
"""Exit code of a server that was."""
REASON: Final = "the server is stopping"
NOT_STARTED: Final = 3
_LOOK_S: Final = 0.02
_SIGHUP: Final = getattr(signal, "SIGHUP", None)
"""None on Windows."""


class ShutdownServer(uvicorn.Server):
    """Stops at the first SIGTERM, SIGINT or SIGHUP, and is ended by a second of the first two.

    A terminal that closes sends SIGHUP more than once.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        app: FastAPI,
        listening: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(config)
        self._app = app
        self._listening = listening

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start; once requests are taken, say where the dashboard is."""
        await super().startup(sockets)
        if self.started:
            url = local_url(self.servers[0].sockets[0].getsockname())
            _log.info("dashboard: %s", url)
            if self._listening is not None:
                self._listening(url)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Stop at signals; unlike uvicorn's own, without raising them again at the end."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {sig: signal.signal(sig, self.handle_exit) for sig in _stop_signals()}
        try:
            yield
        finally:
            for sig, handler in before.items():
                signal.signal(sig, handler)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to stop; at a second signal end at once."""
        if self.should_exit:
            if sig == _SIGHUP:
                return
            signal.signal(sig, signal.SIG_DFL)
            signal.raise_signal(sig)
        # Not within whatever request the signal came in between.
        text = "%s: stopping; once more to end at once"
        Context().run(_log.info, text, signal.Signals(sig).name)
        watch = threading.Timer(STOP_WITHIN_S, _end)
        watch.daemon = True
        watch.start()
        super().handle_exit(sig, frame)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Take no new requests, close the streams, then let uvicorn wait for what is in hand."""
        self._app.state.stopping = True
        for server in self.servers:
            server.close()
        hub = self._app.state.streams
        hub.close(REASON)
        end = asyncio.get_running_loop().time() + STREAMS_S
        while hub.clients and asyncio.get_running_loop().time() < end:
            await asyncio.sleep(_LOOK_S)
        await super().shutdown(sockets)


def local_url(address: tuple[Any, ...]) -> str:
    """Return the URL by which a browser on this machine reaches a listening socket."""
    host = ipaddress.ip_address(address[0].partition("%")[0])
    if host.is_unspecified:
        host = ipaddress.ip_address("127.0.0.1" if host.version == 4 else "::1")
    return f"http://{f'[{host}]' if host.version == 6 else host}:{address[1]}/"


def run_server(
    app: FastAPI, options: dict[str, Any], listening: Callable[[str], None] | None = None
) -> None:
    """Serve until a signal comes; returns when all is closed.

    Args:
        app: the application.
        options: uvicorn's.
        listening: called with the dashboard's URL once requests are taken.

    Raises:
        SystemExit: the server could not start, code 3.
    """
    server = ShutdownServer(uvicorn.Config(app, **options), app, listening)
    server.run()
    if not server.started:
        raise SystemExit(NOT_STARTED)
    _log.info("stopped")


def _stop_signals() -> list[int]:
    """Return the signals to stop at; SIGHUP unless it is ignored, as `nohup` has it."""
    if _SIGHUP is None or signal.getsignal(_SIGHUP) is signal.SIG_IGN:
        return [*HANDLED_SIGNALS]
    return [*HANDLED_SIGNALS, _SIGHUP]


def _end() -> None:
    _log.critical("not stopped after %g s: something hangs; ended", STOP_WITHIN_S)
    logging.shutdown()
    os._exit(NOT_STOPPED)
