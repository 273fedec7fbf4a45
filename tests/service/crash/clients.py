"""Clients that calibrate and activate without a pause, and write down what was acknowledged."""

import itertools
import threading
from collections.abc import Callable
from typing import Any

import httpx

from hardware.simulated.calibration_target import calibration_target_points_mm
from service.api.calibrations.examples import simulated_points

POINTS = simulated_points(2.0 * calibration_target_points_mm()[::2])


class Clients:
    """Each in a thread of its own, until the service is gone or ``stop`` is called.

    What the service acknowledged is in ``calibrations`` (id and hash), ``runs`` (ids),
    ``recordings`` (name and frames that are safe), ``complete`` (names that were stopped) and
    ``activations`` (answers in order); ``attempts`` are the ids of activations that were sent.
    """

    def __init__(self, url: str, name: str) -> None:
        self.calibrations: dict[str, str] = {}
        self.runs: list[str] = []
        self.recordings: dict[str, int] = {}
        self.complete: set[str] = set()
        self.activations: list[str] = []
        self.attempts: list[str] = []
        self.refused: list[httpx.Response] = []
        self.failures: list[str] = []
        self._url = url
        self._name = name
        self._stopping = threading.Event()
        self._threads = [
            threading.Thread(target=self._until_gone, args=(step,))
            for step in (self._calibrate, self._run, self._activate, self._record)
        ]

    @property
    def has_everything(self) -> bool:
        """Whether something of every kind was acknowledged."""
        return all((self.calibrations, self.runs, self.activations, any(self.recordings.values())))

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End, behind the requests in hand."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(240.0)
            assert not thread.is_alive()

    def _until_gone(self, step: Callable[[httpx.Client, int], None]) -> None:
        with httpx.Client(base_url=self._url, timeout=30.0) as client:
            for number in itertools.count():
                if self._stopping.is_set():
                    return
                try:
                    step(client, number)
                except httpx.TransportError as error:
                    self.failures.append(repr(error))
                    self._stopping.wait(0.05)
                except Exception as error:  # noqa: BLE001 - looked at by the test
                    self.failures.append(f"unexpected: {error!r}")
                    return

    def _answer(self, answer: httpx.Response) -> Any:
        """Return what was acknowledged; a refusal is kept."""
        if answer.is_success:
            return answer.json()
        self.refused.append(answer)
        self._stopping.wait(0.02)
        return None

    def _calibrate(self, client: httpx.Client, number: int) -> None:
        name = f"{self._name}-{number}"
        body = {"id": name, "device_id": "sim", "points": POINTS}
        made = self._answer(client.post("/api/v1/calibrations", json=body))
        if made is not None:
            self.calibrations[made["id"]] = made["content_hash"]

    def _run(self, client: httpx.Client, number: int) -> None:
        body = {"device_id": "sim", "points": POINTS, "result_id": f"run-{self._name}-{number}"}
        made = self._answer(client.post("/api/v1/runs/calibration", json=body))
        if made is not None:
            self.runs.append(made["id"])
        self._stopping.wait(0.3)

    def _record(self, client: httpx.Client, number: int) -> None:
        name = f"{self._name}-{number}.h5"
        body = {"id": name}
        if self._answer(client.post("/api/v1/devices/sim/recordings", json=body)) is None:
            return
        self.recordings[name] = 0
        for _ in range(20):
            if self._stopping.wait(0.1):
                break
            found = self._answer(client.get(f"/api/v1/recordings/{name}"))
            if found is not None:
                self.recordings[name] = found["frames_written"] or 0
        stopped = self._answer(client.post(f"/api/v1/recordings/{name}/stop"))
        if stopped is not None:
            self.recordings[name] = stopped["frames_written"]
            self.complete.add(name)

    def _activate(self, client: httpx.Client, number: int) -> None:
        known = ["sim-nominal", *self.calibrations]
        name = known[number % len(known)]
        self.attempts.append(name)
        made = self._answer(client.post(f"/api/v1/calibrations/{name}/activate"))
        if made is not None:
            self.activations.append(name)
