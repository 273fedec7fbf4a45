"""A real server: uvicorn on a free port, SQLite, the simulated device running."""

import socket
import threading
import time
from collections.abc import Iterator

import httpx
import pytest
import uvicorn

from service.app import create_app
from service.cli.serve import server_options
from service.settings import Settings


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Base URL of a running service, ``http://127.0.0.1:PORT``."""
    folder = tmp_path_factory.mktemp("server")
    settings = Settings(
        data_dir=folder, compute_device="cpu", log_level="warning", stream_queue_messages=400
    )
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        running = uvicorn.Server(uvicorn.Config(create_app(settings), **server_options(settings)))
        thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]})
        thread.start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        try:
            end = time.monotonic() + 60.0
            while not running.started:
                assert time.monotonic() < end, "the server did not start"
                time.sleep(0.02)
            assert httpx.get(f"{url}/readyz").status_code == 200
            yield url
        finally:
            running.should_exit = True
            thread.join(30.0)
            assert not thread.is_alive()
