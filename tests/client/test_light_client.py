"""The client loads nothing of the server."""

import subprocess
import sys


def test_the_client_loads_neither_the_server_nor_numpy() -> None:
    script = "import sys, lumiline.client; print(*{name.split('.')[0] for name in sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    assert {"lumiline", "httpx", "websockets"} <= loaded
    assert not loaded & {"compute", "hardware", "service", "numpy", "scipy", "fastapi", "warp"}
