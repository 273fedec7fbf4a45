"""Clients that command at random at two gateways while these are killed: what is said holds.

LUMILINE_TEST_SOAK_S=600 goes on for so long; LUMILINE_TEST_SOAK_SEED repeats one.
"""

import os
import random
import re
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any, Final

import httpx
import pytest

from tests.service.crash.clients import POINTS
from tests.service.crash.process import ServiceProcess
from tests.service.gateways.conftest import WAIT_S, Pair, ask, done, wait_for

SOAK_S: Final = float(os.environ.get("LUMILINE_TEST_SOAK_S", "40"))
MARKERS: Final = [[0, 0, 0], [80, 0, 0], [0, 60, 0], [20, 15, 40]]
ENDED: Final = {"succeeded", "failed", "cancelled", "interrupted"}


class Commands:
    """Threads that command, each at whichever gateway, and one that kills; until ``stop``."""

    def __init__(self, pair: Pair, seed: int) -> None:
        self.faults: list[str] = []
        self.answers: Counter[str] = Counter()
        self.calibrations: dict[str, str] = {}
        self.runs: set[str] = set()
        self.devices: set[str] = set()
        self.revoked: list[str] = []
        self.activations: list[int] = []
        self._pair = pair
        self._stopping = threading.Event()
        self._steps: list[Callable[[random.Random], None]] = [
            self._calibrate, self._run, self._activate, self._activate, self._create_once,
            self._keys, self._tools, self._record, self._disturb,
        ]  # fmt: skip
        self._threads = [
            threading.Thread(target=self._keep, args=(step, random.Random(f"{seed} {number}")))
            for number, step in enumerate(self._steps)
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

    def _keep(self, step: Callable[[random.Random], None], chance: random.Random) -> None:
        while not self._stopping.is_set():
            try:
                step(chance)
            except Exception as error:  # noqa: BLE001 - looked at by the test
                self.faults.append(f"{step}: {error!r}")
                return
            self._stopping.wait(chance.choice([0.0, 0.02, 0.2]))

    def _ask(
        self, at: ServiceProcess, method: str, path: str, body: Any = None, **headers: str
    ) -> httpx.Response | None:
        """Return an answer; None: the gateway was killed, or is."""
        try:
            answer = ask(at, method, path, body, **headers)
        except httpx.TransportError:
            self._stopping.wait(0.1)
            return None
        problem = "" if answer.is_success else answer.json()["type"].rpartition("/")[2]
        kind = f"{method} {re.sub('[0-9]+', 'N', path)} {answer.status_code} {problem}"
        self.answers[kind] += 1
        if answer.status_code >= 500 and answer.status_code != 503:
            self.faults.append(f"{kind}: {answer.text}")
        return answer

    def _any(self, chance: random.Random) -> ServiceProcess:
        return chance.choice(self._pair.processes)

    def _calibrate(self, chance: random.Random) -> None:
        body = {"id": f"c-{chance.getrandbits(40)}", "device_id": "sim", "points": POINTS}
        made = self._ask(self._any(chance), "POST", "/calibrations", body)
        if made is not None and made.is_success:
            self.calibrations[body["id"]] = made.json()["content_hash"]

    def _run(self, chance: random.Random) -> None:
        self._stopping.wait(1.0)  # they are computed one after the other
        name = f"r-{chance.getrandbits(40)}"
        body = {"id": name, "device_id": "sim", "points": POINTS}
        made = self._ask(self._any(chance), "POST", "/runs/calibration", body)
        if made is None or not made.is_success:
            return
        self.runs.add(name)
        if chance.random() < 0.3:
            ended = self._ask(self._any(chance), "POST", f"/runs/{name}/cancel")
            found = self._ask(self._any(chance), "GET", f"/runs/{name}")
            if ended is None or found is None or not found.is_success or not ended.is_success:
                return
            if found.json()["state"] != ended.json()["state"]:
                self.faults.append(f"{name}: {ended.text} became {found.text}")

    def _activate(self, chance: random.Random) -> None:
        """Activate with what was read elsewhere as the precondition."""
        read = self._ask(self._any(chance), "GET", "/devices/sim")
        if read is None or not read.is_success:
            return
        active = read.json()["active_calibration_id"]
        name = chance.choice(["sim-nominal", *self.calibrations])
        path = f"/calibrations/{name}/activate?expected={active}"
        self._ask(self._any(chance), "POST", path)

    def _create_once(self, chance: random.Random) -> None:
        """Send a request with a key again, elsewhere, until it is answered: one is made."""
        name = f"d-{chance.getrandbits(40)}"
        body = {"title": name, "source": {"kind": "external", "sensors": [
            {"name": f"s{number}", "pixels": 2048, "pitch_um": 14} for number in range(3)]},
            "id": name}  # fmt: skip
        end = time.monotonic() + 120.0
        while time.monotonic() < end:
            made = self._ask(self._any(chance), "POST", "/devices", body, Idempotency_Key=name)
            if made is not None and made.is_success:
                self.devices.add(name)
                return
            if made is not None and made.status_code == 409:
                problem = made.json()["type"]
                if problem.endswith("device-exists"):
                    return  # made, and its answer lost with its gateway
            self._stopping.wait(0.3)

    def _keys(self, chance: random.Random) -> None:
        """A key that was revoked is refused everywhere from then on."""
        made = self._ask(
            self._any(chance), "POST", "/keys", {"name": "n", "scopes": ["read:stream"]}
        )
        if made is None or not made.is_success:
            return
        credential = f"Bearer {made.json()['key']}"
        used = self._ask(self._any(chance), "GET", "/devices", Authorization=credential)
        if used is not None and used.status_code == 401:
            self.faults.append(f"a new key is refused: {used.text}")
        ended = self._ask(self._any(chance), "POST", f"/keys/{made.json()['id']}/revoke")
        if ended is None or not ended.is_success:
            return
        self.revoked.append(credential)
        refused = self._ask(self._any(chance), "GET", "/devices", Authorization=credential)
        if refused is not None and refused.is_success:
            self.faults.append("a revoked key was let in")

    def _tools(self, chance: random.Random) -> None:
        name = f"t{chance.randrange(3)}"
        tool = {"id": name, "device_id": "sim", "title": name, "markers_mm": MARKERS}
        hold = {"id": f"h-{name}", "device_id": "sim", "title": name, "limits": {"shift_mm": 5},
                "watch": {"kind": "tool", "tool_id": name}}  # fmt: skip
        method, path, body = chance.choice(
            [
                ("POST", "/tools", tool),
                ("DELETE", f"/tools/{name}", None),
                ("POST", "/beam-holds", hold),
                ("DELETE", f"/beam-holds/h-{name}", None),
                ("GET", f"/beam-holds/h-{name}/state", None),
                ("POST", f"/beam-holds/h-{name}/acknowledge", None),
            ]
        )
        self._ask(self._any(chance), method, path, body)

    def _record(self, chance: random.Random) -> None:
        name = f"sim-{chance.getrandbits(40)}.h5"
        made = self._ask(self._any(chance), "POST", "/devices/sim/recordings", {"id": name})
        if made is None or not made.is_success:
            return
        self._stopping.wait(chance.choice([0.0, 0.3, 1.0]))
        for at in self._pair.processes:
            self._ask(at, "GET", "/recordings")
            self._ask(at, "POST", f"/recordings/{name}/stop")

    def _disturb(self, chance: random.Random) -> None:
        """Kill a gateway and start it again, end it in order, or hold it up."""
        self._stopping.wait(chance.choice([1.0, 4.0, 8.0]))
        one = self._any(chance)
        what = chance.choice(["kill", "kill", "stop", "pause"])
        self.answers[f"disturbed: {what}"] += 1
        if what == "pause":
            os.kill(one.process_id, signal.SIGSTOP)
            self._stopping.wait(chance.choice([0.5, 3.0, 9.0]))
            os.kill(one.process_id, signal.SIGCONT)
            return
        if what == "kill":
            one.kill()
        else:
            one.stop()
        self._stopping.wait(chance.choice([0.0, 1.0, 8.0]))
        one.start()


@pytest.mark.slow
@pytest.mark.postgres
@pytest.mark.timeout(1200 + SOAK_S)
def test_what_is_said_holds_while_gateways_are_killed(new_pair: Pair) -> None:
    seed = int(os.environ.get("LUMILINE_TEST_SOAK_SEED", random.SystemRandom().getrandbits(32)))
    print(f"LUMILINE_TEST_SOAK_SEED={seed}")
    pair = new_pair
    pair.start()
    commands = Commands(pair, seed)
    commands.start()
    time.sleep(SOAK_S)
    commands.stop()
    print(*sorted(f"{count:6d} {kind}" for kind, count in commands.answers.items()), sep="\n")
    assert commands.faults == [], "\n".join(commands.faults)
    assert commands.calibrations
    for at in pair.processes:
        for name, content_hash in commands.calibrations.items():
            assert done(at, "GET", f"/calibrations/{name}")["content_hash"] == content_hash
        for name in commands.devices:
            done(at, "GET", f"/devices/{name}")
        for credential in commands.revoked[-20:]:
            assert ask(at, "GET", "/devices", Authorization=credential).status_code == 401
    for name in commands.runs:
        wait_for(lambda run=name: done(pair.b, "GET", f"/runs/{run}")["state"] in ENDED)
    rows = pair.rows("SELECT calibration_id, previous_calibration_id FROM activations ORDER BY id")
    for before, after in pairwise(rows):
        assert after[1] == before[0]
    # One has the devices, and uses what the database says.
    holder = wait_for(
        lambda: [one for one in pair.processes
                 if ask(one, "GET", "/devices/sim/state").status_code == 200]
    )  # fmt: skip
    assert len(holder) == 1
    active = done(pair.a, "GET", "/devices/sim")["active_calibration_id"]
    wait_for(lambda: done(holder[0], "GET", "/devices/sim/state")["calibration_id"] == active)
    doubled = pair.rows("SELECT count(*) - count(DISTINCT id) FROM devices")
    assert doubled == [(0,)]
    for one in pair.processes:
        lines = [line for line in one.log.splitlines() if "Traceback" in line or " ERROR " in line]
        assert lines == [], one.log[-20000:]
