"""A real server, with a device of a rate that leaves time for the tests."""

from collections.abc import Iterator

import httpx
import pytest

from tests.running_server import serving


@pytest.fixture(scope="package")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Base URL of a running service; its device `sim` streams 100 frames a second."""
    with serving(tmp_path_factory.mktemp("server")) as url:
        httpx.post(f"{url}/api/v1/calibrations/sim-nominal/activate").raise_for_status()
        source = {"kind": "simulated", "settings": {"frame_rate_hz": 100}}
        httpx.patch(
            f"{url}/api/v1/devices/sim", json={"source": source}, headers={"If-Match": "*"}
        ).raise_for_status()
        started = httpx.post(f"{url}/api/v1/devices/sim/start", timeout=60.0)
        started.raise_for_status()
        yield url
