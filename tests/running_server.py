"""A real server in this process: uvicorn on a free port, SQLite, the simulated device."""

import atexit
import functools
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import uvicorn

from service.application.app import create_app
from service.cli.serve import server_options
from service.settings import Settings
from service.station.station_starter import StationStarter


class SharedStarter(StationStarter):
    """Forks the stations of one server after another: to load what they need takes a second."""

    def close(self) -> None:
        """Go on, for the next server."""


@functools.cache
def shared_starter() -> SharedStarter:
    """Return the one of this process."""
    starter = SharedStarter()
    atexit.register(StationStarter.close, starter)
    return starter


@contextmanager
def serving(folder: Path, stream_lag_s: float = 60.0) -> Iterator[str]:
    """Yield the base URL of a running service, ``http://127.0.0.1:PORT``.

    A client may be a minute behind, unless the test is about that: the machine may be busy.
    """
    settings = Settings(
        data_dir=folder,
        compute_device="cpu",
        log_level="warning",
        stream_lag_s=stream_lag_s,
    )
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        app = create_app(settings, starter=shared_starter())
        running = uvicorn.Server(uvicorn.Config(app, **server_options(settings)))
        thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]})
        thread.start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        try:
            end = time.monotonic() + 240.0
            while not running.started:
                assert thread.is_alive(), "the server ended"
                assert time.monotonic() < end, "the server did not start"
                time.sleep(0.02)
            assert httpx.get(f"{url}/readyz").status_code == 200
            yield url
        finally:
            running.should_exit = True
            thread.join(240.0)
            assert not thread.is_alive()
