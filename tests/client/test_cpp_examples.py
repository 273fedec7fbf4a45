"""The C++ examples of the stream and of OpenIGTLink: compiled as they say, beside a server."""

import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from lumiline.client import Client
from service.cli.service_process import free_port, service_process
from tests.compute.native.host import compiler

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples" / "cpp"
HEADERS = {"stream": "boost/beast/websocket.hpp", "openigtlink": "openigtlink/igtlStatusMessage.h"}
MARKERS = [(0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (20.0, 15.0, 40.0)]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(compiler() is None, reason="no C++ compiler (c++, g++)"),
]


def built(name: str, folder: Path) -> Path:
    """Return the program of an example, made with the command that is written in it."""
    if not (Path("/usr/include") / HEADERS[name]).exists():
        pytest.skip(f"no {HEADERS[name]}; the example says which packages have it")
    (command,) = re.findall(r"^// .*(g\+\+ -std.*)$", (EXAMPLES / f"{name}.cpp").read_text(), re.M)
    words = [*command.split(), "-Wall", "-Wextra", "-Werror"]
    words = [str(EXAMPLES / word) if word == f"{name}.cpp" else word for word in words]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / name


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Client, int]]:
    """A client of a server with a moving tool, and the server's OpenIGTLink port."""
    port = free_port()
    settings = {"openigtlink_port": str(port)}
    with (
        service_process(tmp_path_factory.mktemp("data"), settings, quiet=True) as service,
        Client(service.url, timeout_s=60.0) as client,
    ):
        scene = {"kind": "moving-tools", "tools": [{"markers_mm": MARKERS}]}
        source = {"kind": "simulated", "settings": {"frame_rate_hz": 100, "scene": scene}}
        client.change_device("sim", source=source)
        client.create_tool(id="probe", device_id="sim", title="Probe", markers_mm=MARKERS,
                           strobe_markers=[0, 1, 2, 3])  # fmt: skip
        client.start_device("sim")
        end = time.monotonic() + 240.0
        while client.tool_pose("probe").status != "OK":
            assert time.monotonic() < end
            time.sleep(0.1)
        yield client, port


def lines_of(program: list[str | Path], count: int) -> list[str]:
    """Return the first lines that a program prints."""
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            return [process.stdout.readline() for _ in range(count)]
        finally:
            process.kill()


def test_stream_example_prints_points(tracked: tuple[Client, int], tmp_path: Path) -> None:
    program = built("stream", tmp_path)
    url = httpx.URL(tracked[0]._server.url)
    lines = lines_of([program, url.host, str(url.port), "sim"], 40)
    place = re.compile(r"\d+ \d{19} [0-3] \[-?[\d.e-]+,-?[\d.e-]+,-?[\d.e-]+\] mm\n")
    assert sum(place.fullmatch(line) is not None for line in lines) > 30, lines
    # A device that there is not: the server's refusal ends it.
    refused = subprocess.run(
        [program, url.host, str(url.port), "none"], capture_output=True, text=True
    )
    assert refused.returncode == 1
    assert "the stream ended" in refused.stderr


def test_openigtlink_example_prints_poses(tracked: tuple[Client, int], tmp_path: Path) -> None:
    program = built("openigtlink", tmp_path)
    lines = lines_of([program, "127.0.0.1", str(tracked[1])], 40)
    pose = re.compile(r"\d+\.\d{6} probeToTracker -?[\d.]+ -?[\d.]+ -?[\d.]+ mm\n")
    assert sum(pose.fullmatch(line) is not None for line in lines) > 30, lines
