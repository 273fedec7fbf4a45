"""Clients that command at random while the station is killed and held up: what is said holds.

LUMILINE_TEST_SOAK_S=600 goes on for so long; LUMILINE_TEST_SOAK_BUSY=8 has so many busy processes
beside it.
"""

import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

import httpx
import msgpack
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from hardware.recording.reader import RecordingReader
from tests.service.crash.clients import POINTS
from tests.service.crash.process import ServiceProcess

SOAK_S: Final = float(os.environ.get("LUMILINE_TEST_SOAK_S", "20"))
BUSY: Final = int(os.environ.get("LUMILINE_TEST_SOAK_BUSY", "0"))
WAIT_S: Final = 240.0
MARKERS: Final = [[0, 0, 0], [80, 0, 0], [0, 60, 0], [20, 15, 40]]
TOOL: Final = {"id": "pointer", "device_id": "sim", "title": "Pointer", "markers_mm": MARKERS,
               "strobe_markers": [0, 1, 2, 3], "tip_mm": [-150, 0, 0]}  # fmt: skip
HOLD: Final = {"device_id": "sim", "title": "Chest", "limits": {"shift_mm": 5},
               "watch": {"kind": "tool", "tool_id": "pointer"}}  # fmt: skip
SCENE: Final = {"kind": "moving-tools", "moving": False,
                "tools": [{"markers_mm": MARKERS, "centre_mm": [0, 0, 1500]}]}  # fmt: skip
LIVE: Final = {"starting", "running", "disconnected"}


class Commands:
    """Threads that command at random, until ``stop``; what is wrong is in ``faults``."""

    def __init__(self, service: ServiceProcess, seed: int) -> None:
        self.faults: list[str] = []
        self.answers: Counter[str] = Counter()
        self.recordings: dict[str, int] = {}
        self._service = service
        self._stopping = threading.Event()
        self._threads = [
            threading.Thread(target=self._keep, args=(step, random.Random(f"{seed} {number}")))
            for number, step in enumerate(
                [
                    partial(self._switch, "sim"),
                    partial(self._switch, "second"),
                    partial(self._record, "sim"),
                    partial(self._record, "second"),
                    self._hold,
                    self._refer,
                    self._watch,
                    self._watch,
                    self._disturb,
                ]
            )
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        self._stopping.set()
        for thread in self._threads:
            thread.join(WAIT_S)
            if thread.is_alive():
                self.faults.append(f"{thread.name} does not end")

    def _keep(
        self, step: Callable[[httpx.Client, random.Random], None], chance: random.Random
    ) -> None:
        with httpx.Client(base_url=f"{self._service.url}/api/v1", timeout=WAIT_S) as client:
            while not self._stopping.is_set():
                try:
                    step(client, chance)
                except Exception as error:  # noqa: BLE001 - looked at by the test
                    self.faults.append(f"{step}: {error!r}")
                    return

    def _ask(self, client: httpx.Client, method: str, path: str, body: Any = None) -> Any:
        """Return what is answered; None: it was refused, with a reason that may be."""
        headers = {"If-Match": "*"} if method == "PATCH" else {}
        begin = time.monotonic()
        answer = client.request(method, path, json=body, headers=headers)
        code = "" if answer.is_success else answer.json()["type"].rpartition("/")[2]
        kind = f"{method} {re.sub('-[0-9]+.h5', '', path)} {answer.status_code} {code}"
        self.answers[kind] += 1
        if answer.status_code >= 500 and answer.status_code != 503:
            self.faults.append(f"{kind}: {answer.text}")
        if time.monotonic() - begin > 60.0:
            self.faults.append(f"{kind}: after {time.monotonic() - begin:.0f} s: {answer.text}")
        if not answer.is_success or answer.status_code == 204:
            return None
        return answer.json()

    def _switch(self, device: str, client: httpx.Client, chance: random.Random) -> None:
        """Start, stop, restart, change; the only one who does that with this device."""
        what = chance.choice(["start", "stop", "restart", "activate", "tracking", "state"])
        if what == "restart":
            self._switch_to(device, "stop", client)
            what = "start"
        if what in {"start", "stop"}:
            self._switch_to(device, what, client)
        elif what == "activate" and device == "sim":
            self._ask(
                client, "POST", f"/calibrations/{chance.choice(['sim-nominal', 'other'])}/activate"
            )
        elif what == "tracking" and device == "sim":
            tracks = chance.choice(["never", "with-tools", "always"])
            self._ask(client, "PATCH", f"/devices/{device}", {"tracking": {"tracks": tracks}})
        else:
            self._ask(client, "GET", f"/devices/{device}/state")
        self._stopping.wait(chance.choice([0.0, 0.01, 0.1, 0.5, 1.0]))

    def _switch_to(self, device: str, what: str, client: httpx.Client) -> None:
        if self._ask(client, "POST", f"/devices/{device}/{what}") is None:
            return
        state = self._ask(client, "GET", f"/devices/{device}/state")
        if (state["state"] in LIVE) is not (what == "start"):
            self.faults.append(f"{device} after {what}: {state}")

    def _record(self, device: str, client: httpx.Client, chance: random.Random) -> None:
        """Record for a moment; what is said to be written is there."""
        name = f"{device}-{chance.getrandbits(40)}.h5"
        if self._ask(client, "POST", f"/devices/{device}/recordings", {"id": name}) is None:
            self._stopping.wait(0.1)
            return
        self.recordings[name] = 0
        self._stopping.wait(chance.choice([0.0, 0.05, 0.3, 1.5]))
        stopped = self._ask(client, "POST", f"/recordings/{name}/stop")
        known = stopped or self._ask(client, "GET", f"/recordings/{name}")
        if known is None:
            self.faults.append(f"{name} was begun and is not known")
        else:
            self.recordings[name] = known["frames_written"] or 0

    def _hold(self, client: httpx.Client, chance: random.Random) -> None:
        """Make, change, delete a hold, and acknowledge the other one."""
        name = f"/beam-holds/h{chance.randrange(3)}"
        what = chance.choice(["POST", "PATCH", "DELETE", "GET", "acknowledge"])
        if what == "POST":
            self._ask(client, "POST", "/beam-holds", HOLD | {"id": name[-2:]})
        elif what == "PATCH":
            self._ask(client, "PATCH", name, {"limits": {"shift_mm": chance.uniform(1, 9)}})
        elif what == "DELETE":
            self._ask(client, "DELETE", name)
        elif what == "GET":
            self._ask(client, "GET", f"{name}/state")
        else:
            self._ask(
                client, "POST", f"/beam-holds/{chance.choice(['chest', name[-2:]])}/acknowledge"
            )
        self._stopping.wait(chance.choice([0.0, 0.05, 0.3]))

    def _refer(self, client: httpx.Client, chance: random.Random) -> None:
        """Measure the reference of a hold, or take it away."""
        if chance.random() < 0.3:
            self._ask(client, "DELETE", "/beam-holds/chest/reference")
        else:
            body = {"frames": 20, "timeout_s": 2.0}
            self._ask(client, "POST", "/beam-holds/chest/reference", body)
        self._stopping.wait(chance.choice([0.0, 0.3, 1.0]))

    def _watch(self, _client: httpx.Client, chance: random.Random) -> None:
        """Read a stream for a while; frames of one start come in order."""
        device = chance.choice(["sim", "sim", "second"])
        more = chance.choice(["", "&mode=lossless"])
        content = chance.choice(["points", "peaks", "points,tools,holds,tracks"])
        address = self._service.url.replace("http", "ws", 1)
        url = f"{address}/api/v1/stream?device_id={device}&content={content}&encoding=msgpack{more}"
        end = time.monotonic() + chance.choice([0.1, 1.0, 5.0])
        newest, told = -1, []
        with suppress(TimeoutError, ConnectionClosed), connect(url, open_timeout=60.0) as stream:
            while time.monotonic() < end and not self._stopping.is_set():
                message = msgpack.unpackb(stream.recv(timeout=1.0))
                self.answers[f"stream {message['type']}"] += 1
                if message["type"] == "state":
                    told.append((newest, message["state"], message["reason"]))
                if message["type"] == "state" and message["state"] == "starting":
                    newest = -1
                for frame in message.get("frames", [message]):
                    if frame["type"] != "frame":
                        continue
                    if frame["sequence"] <= newest:
                        self.faults.append(f"{device}: {frame['sequence']} behind {newest}: {told}")
                    newest = frame["sequence"]

    def _disturb(self, _client: httpx.Client, chance: random.Random) -> None:
        """Kill the station, or whoever starts it, or hold it up."""
        self._stopping.wait(chance.choice([0.5, 2.0, 5.0]))
        starters = children(self._service.process_id)
        stations = [one for starter in starters for one in children(starter)]
        what = chance.choice(["station", "station", "pause", "both", "starter"])
        self.answers[f"disturbed: {what}"] += 1
        with suppress(ProcessLookupError):
            if what in {"starter", "both"}:
                for one in starters:
                    os.kill(one, signal.SIGKILL)
            if what in {"station", "both"}:
                for one in stations:
                    os.kill(one, signal.SIGKILL)
            if what == "pause":
                for one in stations:
                    os.kill(one, signal.SIGSTOP)
                self._stopping.wait(chance.choice([0.02, 0.3, 1.5]))
                for one in stations:
                    os.kill(one, signal.SIGCONT)


def children(process: int) -> list[int]:
    """Processes that a process has started and that still run."""
    try:
        return [
            int(one) for one in Path(f"/proc/{process}/task/{process}/children").read_text().split()
        ]
    except OSError:
        return []


@contextmanager
def busy_processes(number: int) -> Iterator[None]:
    started = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)]
    try:
        yield
    finally:
        for one in started:
            one.kill()
            one.wait()


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def is_running(client: httpx.Client, path: str) -> bool:
    """Whether a device runs; it is started where it does not."""
    client.post(f"{path}/start")
    state = client.get(f"{path}/state").json()
    return state["state"] == "running" and state["frames_received"] > 0


def check_recordings(folder: Path, recordings: dict[str, int]) -> None:
    for name, written in recordings.items():
        with RecordingReader(folder / name) as recording:
            sequences = [frame.sequence for frame in recording.frames()]
        assert len(sequences) >= written, name
        assert sequences == sorted(set(sequences)), name


@pytest.mark.slow
@pytest.mark.timeout(900 + SOAK_S)
def test_what_is_said_holds_while_the_station_is_killed_and_held_up(tmp_path: Path) -> None:
    seed = int(os.environ.get("LUMILINE_TEST_SOAK_SEED", random.SystemRandom().getrandbits(32)))
    print(f"LUMILINE_TEST_SOAK_SEED={seed}")
    service = ServiceProcess(tmp_path)
    service.start()
    try:
        with httpx.Client(base_url=f"{service.url}/api/v1", timeout=WAIT_S) as client:

            def do(method: str, path: str, body: Any = None) -> Any:
                answer = client.request(method, path, json=body, headers={"If-Match": "*"})
                assert answer.is_success, answer.text
                return answer.json()

            second = {"id": "second", "title": "Second", "source": {"kind": "simulated"}}
            settings = {"frame_rate_hz": 400.0, "scene": SCENE}
            do("PATCH", "/devices/sim", {"source": {"kind": "simulated", "settings": settings}})
            do("POST", "/devices", second)
            do("POST", "/calibrations", {"id": "other", "device_id": "sim", "points": POINTS})
            do("POST", "/tools", TOOL)
            do("POST", "/beam-holds", HOLD | {"id": "chest"})
            with busy_processes(BUSY):
                commands = Commands(service, seed)
                commands.start()
                time.sleep(SOAK_S)
                commands.stop()
            print(
                *sorted(f"{count:6d} {kind}" for kind, count in commands.answers.items()), sep="\n"
            )
            assert commands.faults == [], "\n".join(commands.faults)
            # All goes on, however it was left.
            do("PATCH", "/devices/sim", {"tracking": {"tracks": "with-tools"}})
            for device in ("sim", "second"):
                wait_for(lambda path=f"/devices/{device}": is_running(client, path))
            do("POST", "/beam-holds/chest/reference", {"frames": 20, "timeout_s": 60.0})
            wait_for(lambda: not do("GET", "/beam-holds/chest/state")["held"])
    finally:
        service.stop()
    check_recordings(tmp_path / "data" / "recordings", commands.recordings)
    # That the database is slow may be so.
    lines = [
        line
        for line in service.log.splitlines()
        if ("Traceback" in line or " ERROR " in line) and "is not written down yet" not in line
    ]
    assert lines == [], service.log[-20000:]
