"""Every shell command of README and docs: run from where its reader would be, page by page.

A command is run as it is written, with three exceptions: the address of the server is that of the
test's, words in capitals and ids of examples stand for what the reader has (``PLACEHOLDERS``), and
files that the page takes for granted are there before (``PREPARE``).
"""

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import httpx
import pytest

from tests.running_server import serving
from tests.service.cli.test_all_commands import COMMANDS

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = ["README.md", *sorted(str(p.relative_to(ROOT)) for p in ROOT.glob("docs/**/*.md"))]
ADDRESS: Final = "localhost:8000"
TIMEOUT_S: Final = 400.0

PROGRAMS: Final = frozenset(
    {"lumiline", ".venv/bin/lumiline", "curl", "until", "make", "head", "python", "cc", "source",
     "export", "docker", "docker/install.sh", "docker/prebuild.sh", "apt-get"}
)  # fmt: skip
"""First words by which a block without a language is told to be commands."""
SHELLS: Final = frozenset({"bash", "sh", "shell", "console"})

ENDLESS: Final = ("lumiline serve", "lumiline simulate-serial", "lumiline beam-holds watch")
"""Commands that run until they are ended."""

SKIPPED: Final = {
    ("README.md", "make"): "minutes each; CI runs both, and `make test` would run itself",
    ("docs/how-to/devices.md", "curl"): "a device on a USB port",
    ("docs/how-to/genicam.md", "apt-get"): "changes the machine",
    ("docs/how-to/genicam.md", "lumiline cameras"): "needs that library",
    ("docs/how-to/genicam.md", "curl"): "cameras in a network",
    ("docs/how-to/operation.md", "docker/"): "tests/docker",
    ("docs/how-to/operation.md", "docker compose"): "needs Docker; CI runs the image",
    ("docs/how-to/operation.md", "export"): "for Docker",
    ("docs/how-to/radiometric-calibration.md", "lumiline radiometric-calibration capture"):
        "a person changes the light and presses Enter; "
        "tests/service/cli/test_radiometric_calibration.py",
    ("docs/how-to/radiometric-calibration.md", "lumiline radiometric-calibration line-shape"):
        "a person moves a marker; test_recorded_lines.py",
    ("docs/how-to/radiometric-calibration.md", "lumiline radiometric-calibration upload shaped"):
        "the file of the line before",
    ("docs/how-to/tcd1304.md", "curl"): "boards on USB ports",
    ("docs/how-to/tools.md", "curl -s localhost:8000/api/v1/tools/pointer/points"):
        "a person holds the tip still; tests/service/api/tools",
    ("docs/how-to/tools.md", "lumiline tools point"):
        "a person holds the tip still; tests/service/api/tools",
    ("docs/how-to/webhooks.md", "curl"): "a server and an alarm with names of their own",
    ("docs/reference/versions.md", "python docs/generators/contract.py "):
        "writes into the repository",
    ("docs/tutorial/index.md", "make"): "makes the environment that the tests run in",
    ("docs/tutorial/index.md", "source"): "makes the environment that the tests run in",
}  # fmt: skip
"""By page and beginning of the command: why it is not run."""


@dataclass(frozen=True)
class Command:
    """A command of a page and its first line there."""

    text: str
    line: int


def shell_blocks(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield first line and lines of each block of commands."""
    fence, body = "", list[str]()
    for number, line in enumerate(text.splitlines(), 1):
        mark = re.match(r"^\s*(`{3,})(.*)$", line)
        if mark and not fence:
            fence, language, start, body = mark[1], mark[2].strip(), number + 1, []
        elif mark and mark[1] == fence and not mark[2].strip():
            fence = ""
            first = next((one for one in map(_program, body) if one), "")
            if language in SHELLS or (language in ("", "text") and first in PROGRAMS):
                yield start, body
        elif fence:
            body.append(line)
    assert not fence


def _program(line: str) -> str:
    """Return the first word of a line that is no variable; empty for comments."""
    words = line.split()
    while words and re.match(r"[A-Z][A-Z_]+=", words[0]):
        words = words[1:]
    return "" if not words or words[0].startswith("#") else words[0]


def commands(text: str) -> list[Command]:
    """Return all commands of a page; one may take several lines."""
    found = []
    for start, body in shell_blocks(text):
        pending, first = "", start
        for number, line in enumerate(body, start):
            first = first if pending else number
            pending += line + "\n"
            try:
                done = not line.endswith("\\")
                done = (bool(shlex.split(pending, comments=True)) and done) or not pending.strip()
            except ValueError:  # a quotation that goes on in the next line
                continue
            if done or line.lstrip().startswith("#"):
                if shlex.split(pending, comments=True):
                    found.append(Command(pending.strip(), first))
                pending = ""
        assert not pending, (start, pending)
    return found


@dataclass
class Reader:
    """Somebody who follows a page: folder, server, and what the page calls by placeholders."""

    folder: Path
    server: Path
    address: str
    values: dict[str, str] = field(default_factory=dict)

    @property
    def environment(self) -> dict[str, str]:
        """Of the commands; nothing of the user's own is read or written."""
        own = {k: v for k, v in os.environ.items() if not k.startswith("LUMILINE_")}
        return own | {
            "PATH": f"{self.folder / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT),
            "COLUMNS": "120", "HOME": str(self.folder), "SHELL": "/bin/bash",
            "LUMILINE_URL": f"http://{self.address}",
            "LUMILINE_DATA_DIR": str(self.folder / "data"), "LUMILINE_COMPUTE_DEVICE": "cpu",
        }  # fmt: skip

    def request(self, method: str, path: str, body: Any = None) -> Any:
        """Return the server's answer."""
        answer = httpx.request(
            method, f"http://{self.address}/api/v1/{path}", json=body, timeout=120.0,
            headers={"if-match": "*"},
        )  # fmt: skip
        assert answer.is_success, answer.text
        return answer.json() if answer.content else None

    def run(self, text: str) -> str:
        """Return what a command prints; it must succeed."""
        done = subprocess.run(
            # Not the last command of bash: the shell is there to be found by --install-completion.
            ["bash", "-euo", "pipefail", "-c", f"{text}\n:"],
            cwd=self.folder, env=self.environment, capture_output=True, text=True,
            timeout=TIMEOUT_S, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        assert done.returncode == 0, (text, done.stdout[-2000:], done.stderr[-2000:])
        return done.stdout

    def write(self, name: str, content: Any) -> None:
        """Write a JSON file."""
        (self.folder / name).write_text(json.dumps(content), encoding="utf-8")

    def example(self, path: str, method: str = "post") -> Any:
        """Return the first example body of an operation in the OpenAPI document."""
        document = httpx.get(f"http://{self.address}/openapi.json", timeout=120.0).json()
        content = document["paths"][f"/api/v1/{path}"][method]["requestBody"]["content"]
        return next(iter(content["application/json"]["examples"].values()))["value"]

    def finished(self, run_id: str) -> Any:
        """Return a run when it has succeeded."""
        end = time.monotonic() + TIMEOUT_S
        while (run := self.request("GET", f"runs/{run_id}"))["state"] in ("queued", "running"):
            assert time.monotonic() < end, run
            time.sleep(0.2)
        assert run["state"] == "succeeded", run
        return run

    def simulate(self, scene: dict[str, Any], **settings: Any) -> dict[str, Any]:
        """Return the source of a simulated device."""
        return {"kind": "simulated", "settings": {"scene": scene, **settings}}

    def record(self, name: str, scene: dict[str, Any], seconds: float, **settings: Any) -> None:
        """Record a simulated scene without a server."""
        self.write("simulation.json", {"scene": scene, **settings})
        self.run(f"lumiline record {name} --simulation simulation.json --seconds {seconds}")

    def running(self, device_id: str, source: dict[str, Any]) -> None:
        """Make a device and start it."""
        body = {"id": device_id, "title": device_id, "source": source}
        self.request("POST", "devices", body)
        self.request("POST", f"devices/{device_id}/start")


TOOL: Final = [[0, 0, 0], [80, 0, 0], [0, 60, 0], [20, 15, 40]]
MOVING_TOOL: Final = {"kind": "moving-tools", "tools": [{"markers_mm": TOOL}]}


def _tool(device_id: str, tool_id: str = "pointer") -> dict[str, Any]:
    return {"id": tool_id, "device_id": device_id, "title": tool_id, "markers_mm": TOOL,
            "strobe_markers": [0, 1, 2, 3], "tip_mm": [-150, 0, 0]}  # fmt: skip


def _calibration(reader: Reader) -> None:
    reader.run("lumiline examples . --force")
    frame = reader.example("runs/calibration")
    reader.write("frame.json", frame)
    reader.write("places.json", reader.example("runs/mapping"))
    reader.write("markers.json", reader.example("calibrations/{calibration_id}/drift-checks"))
    wand = {"kind": "waved-wand", "length_mm": 300}
    reader.running("bench", reader.simulate(wand, frame_rate_hz=200))
    reader.record("waved.h5", wand, 60.0, frame_rate_hz=100)


def _exports(reader: Reader) -> None:
    reader.running("bar", reader.simulate(MOVING_TOOL, frame_rate_hz=200))
    reader.request("POST", "tools", _tool("bar"))
    reader.write("tools.json", reader.request("GET", "tools?device_id=bar"))
    reader.record("recording.h5", MOVING_TOOL, 1.0, frame_rate_hz=200)
    (reader.server / "recordings").mkdir(exist_ok=True)
    shutil.copy(reader.folder / "recording.h5", reader.server / "recordings" / "walk.h5")


def _planning(reader: Reader) -> None:
    reader.run("lumiline examples . --force")
    shutil.copy(reader.folder / "my-bar.toml", reader.folder / "my-device.toml")


def _radiometric(reader: Reader) -> None:
    reader.running("bar", reader.simulate({"kind": "rotating-bar"}, frame_rate_hz=100))
    for name, electrons in (("dark", 0), ("low", 12000), ("high", 30000)):
        light = {"kind": "even-light", "electrons": electrons}
        reader.record(f"{name}.h5", light, 1.0, frame_rate_hz=100)


def _recordings(reader: Reader) -> None:
    reader.run("lumiline examples . --force")
    shutil.copy(reader.folder / "nominal.json", reader.folder / "camera.json")
    reader.run("lumiline map volume.csv --calibration camera.json --output corrections.h5")
    reader.record("frame.h5", {"kind": "calibration-frame"}, 2.0, frame_rate_hz=400)
    capture = reader.example("captures")
    reader.write("targets.json", capture["targets"])
    reader.record("wand.h5", {"kind": "calibration-frame"}, 2.0, frame_rate_hz=400)


def _tools(reader: Reader) -> None:
    reader.running("bar", reader.simulate(MOVING_TOOL, frame_rate_hz=100))
    reader.write("probe.json", _tool("sim", "probe") | {"strobe_markers": [4, 5, 6, 7]})
    reader.write("tools.json", [_tool("bar", "stylus")])


def _reference(reader: Reader) -> None:
    reader.request("POST", "tools", _tool("sim"))
    reader.write("points.json", reader.example("calibrations"))
    reader.write("lines.json", reader.example("line-scans"))
    reader.run("lumiline examples .")
    reader.write("nominal.json", reader.request("GET", "calibrations/sim-nominal"))
    reader.run("lumiline map volume.csv --calibration nominal.json --output sim-map.h5")
    table = (reader.folder / "sim-map.h5").read_bytes()
    answer = httpx.post(
        f"http://{reader.address}/api/v1/correction-tables", params={"id": "sim-map"},
        content=table, headers={"content-type": "application/x-hdf5"}, timeout=60.0,
    )  # fmt: skip
    assert answer.is_success, answer.text


def _etag(reader: Reader) -> str:
    answer = httpx.get(f"http://{reader.address}/api/v1/tools/pointer")
    return answer.headers["etag"]


PREPARE: Final[dict[str, Callable[[Reader], None]]] = {
    "docs/how-to/calibration.md": _calibration,
    "docs/how-to/exports.md": _exports,
    "docs/how-to/planning.md": _planning,
    "docs/how-to/profiles.md": _planning,
    "docs/how-to/radiometric-calibration.md": _radiometric,
    "docs/how-to/recordings.md": _recordings,
    "docs/how-to/tools.md": _tools,
    "docs/reference/api.md": _reference,
}
"""By page: what its reader has before it begins."""

PLACEHOLDERS: Final[dict[str, dict[str, Callable[[Reader], str]]]] = {
    "docs/how-to/calibration.md": {
        "/RUN": lambda reader: f"/{reader.values['runs']}",
        "/ID": lambda reader: "/sim-nominal",
        "CHECK": lambda reader: reader.values["drift-checks"],
        "/TABLE": lambda reader: f"/{reader.finished(reader.values['runs'])['result_id']}",
    },
    "docs/how-to/exports.md": {
        "/RUN": lambda reader: f"/{reader.finished(reader.values['runs'])['id']}",
    },
    "docs/how-to/security.md": {
        "k3f90aq7m2xd": lambda reader: json.loads(reader.run("lumiline keys list --json"))[0]["id"],
    },
    "docs/reference/api.md": {'"5f0c..."': _etag},
}  # fmt: skip
"""By page and text: what it stands for."""


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `lumiline`, and with a `curl` that fails where the server refuses."""
    folder: Path = tmp_path_factory.mktemp("bin")
    curl = shutil.which("curl")
    for name, line in (
        ("lumiline", f'exec "{sys.executable}" -m service.cli "$@"'),
        ("python", f'exec "{sys.executable}" "$@"'),
        ("curl", f'exec "{curl}" --fail-with-body "$@"'),
    ):
        (folder / name).write_text(f"#!/bin/sh\n{line}\n", encoding="utf-8")
        (folder / name).chmod(0o755)
    return folder


@contextmanager
def reading(page: str, folder: Path, programs: Path) -> Iterator[Reader]:
    """Yield a reader in a folder like the repository's, with a new server."""
    here, data = folder / "here", folder / "server"
    here.mkdir()
    data.mkdir()
    shutil.copytree(ROOT / "docs" / "examples", here / "docs" / "examples")
    (here / "docs" / "generators").symlink_to(ROOT / "docs" / "generators")
    (here / "docs" / "reference").symlink_to(ROOT / "docs" / "reference")
    (here / "hardware").symlink_to(ROOT / "hardware")
    (here / "bin").symlink_to(programs)
    (here / ".venv").mkdir()
    (here / ".venv" / "bin").symlink_to(programs)
    with serving(data) as url:
        reader = Reader(here, data, url.removeprefix("http://"))
        if page in PREPARE:
            PREPARE[page](reader)
        yield reader


def free_port() -> int:
    """Return a port that nobody uses."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def follow(reader: Reader, page: str, command: Command) -> None:
    """Run a command as the page's reader would."""
    text = command.text.replace(ADDRESS, reader.address)
    for word, value in PLACEHOLDERS.get(page, {}).items():
        if word in text:
            text = text.replace(word, value(reader))
    for port in re.findall(r"(?:PORT=|127\.0\.0\.1:)(\d{4,5})\b", text):
        if f"127.0.0.1:{port}" != reader.address:
            text = text.replace(port, reader.values.setdefault(port, str(free_port())))
    program = text.removeprefix(".venv/bin/").split("=")[0]
    if any(one in text for one in ENDLESS) and not program.startswith("until"):
        run_endless(reader, text)
        return
    printed = reader.run(text)
    if text.startswith("curl") and printed.startswith("{"):
        answer, address = json.loads(printed), re.search(r"/api/v1/([\w/-]+)", text)
        if "id" in answer and address is not None:
            kind = "runs" if address[1].startswith("runs") else address[1].split("/")[-1]
            reader.values[kind] = str(answer["id"])


def run_endless(reader: Reader, text: str) -> None:
    """Start a command, wait until it does its work, and end it as Ctrl-C does."""
    port = free_port()
    process = subprocess.Popen(
        ["bash", "-c", f"exec {text}" if "=" not in text.split()[0] else f"env {text}"],
        cwd=reader.folder, env=reader.environment | {"LUMILINE_PORT": str(port)},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, stdin=subprocess.DEVNULL,
        # Ignored in what a shell runs in the background, and so would be Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert process.stdout is not None
    first = ""
    if "serve" in text.split():
        end = time.monotonic() + TIMEOUT_S
        while True:
            assert process.poll() is None, process.stdout.read()
            assert time.monotonic() < end, text
            try:
                if httpx.get(f"http://127.0.0.1:{port}/readyz", timeout=5.0).status_code == 200:
                    break
            except httpx.TransportError:
                time.sleep(0.2)
    else:
        first = process.stdout.readline()
        assert first, text
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=60.0)
    # A watch ends with 1 where the beam is held then.
    ends = (0, -signal.SIGINT, *([1] if "beam-holds watch" in text else []))
    assert process.returncode in ends, (text, first + printed)


def skipped(page: str, command: Command) -> str | None:
    """Return why a command is not run."""
    for (where, beginning), reason in SKIPPED.items():
        if where == page and f"{command.text} ".startswith(beginning):
            return reason
    return None


ALL: Final = {page: commands((ROOT / page).read_text(encoding="utf-8")) for page in PAGES}
ELSEWHERE: Final = frozenset(
    {"docs/tutorial/calibrate-and-measure.md", "docs/tutorial/track-a-tool.md",
     "docs/how-to/your-first-device.md"}
)  # fmt: skip
"""Pages with programs between the commands: test_tutorial.py, test_first_device.py."""
RUN: Final = [
    page
    for page, listed in ALL.items()
    if page not in ELSEWHERE and any(skipped(page, one) is None for one in listed)
]


def test_commands_reasons_and_preparations_are_of_commands_that_are_there() -> None:
    for page, beginning in SKIPPED:
        assert any(f"{one.text} ".startswith(beginning) for one in ALL[page]), (page, beginning)
    for page, words in PLACEHOLDERS.items():
        for word in words:
            assert any(word in one.text for one in ALL[page]), (page, word)
    assert set(PREPARE) <= set(RUN)


def test_commands_found_in_each_form() -> None:
    text = (
        "```\nlumiline a  # said\n\n# why\nX=1 lumiline b\n```\n```json\n{}\n```\n"
        "```text\ncurl x \\\n  -d '{\n  \"a\": 1}'\nlumiline c\n```\n```text\nwords\n```\n"
    )
    assert commands(text) == [
        Command("lumiline a  # said", 2), Command("X=1 lumiline b", 5),
        Command("curl x \\\n  -d '{\n  \"a\": 1}'", 11), Command("lumiline c", 14),
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(1100)  # README's have a demo, wands and maps
@pytest.mark.parametrize("page", RUN)
def test_commands_of_a_page_succeed_in_order(page: str, tmp_path: Path, programs: Path) -> None:
    with reading(page, tmp_path, programs) as reader:
        for command in ALL[page]:
            if skipped(page, command) is None:
                try:
                    follow(reader, page, command)
                except (AssertionError, subprocess.SubprocessError, LookupError) as error:
                    raise AssertionError(f"{page}:{command.line}: {command.text}") from error


def unknown_options(text: str) -> list[str]:
    """Return the options of commands that stand in a line of prose, and that they have not."""
    found = []
    for quoted in re.findall(r"`(?:LUMILINE_\w+=\S+ )?(lumiline [^`\n]+)`", text):
        words = quoted.split()[1:]
        name = " ".join(words[:2]) if " ".join(words[:2]) in COMMANDS else words[0]
        if name not in COMMANDS:
            continue  # a group of commands, or an option of all
        known = {option for one in COMMANDS[name].params for option in one.opts}
        named = set(re.findall(r"(?<![\w-])--[a-z-]+", quoted))
        found += [f"{quoted}: {option}" for option in sorted(named - known - {"--help"})]
    return found


def test_commands_in_prose_have_the_options_that_are_named() -> None:
    for page in PAGES:
        assert not unknown_options((ROOT / page).read_text(encoding="utf-8")), page


def test_unknown_options_finds_one_that_is_not_there() -> None:
    assert unknown_options("`lumiline drift a.csv --sensors s3`, `lumiline plan --grid 3`") == [
        "lumiline drift a.csv --sensors s3: --sensors"
    ]
