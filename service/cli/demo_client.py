"""Client of the demo: REST and websocket only."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.live import receive
from lumiline.client import Client
from validation.thesis_data import DFW_V500, load_test

Array = NDArray[np.float64]

THESIS_DEVICE = "thesis-frame"
SIMULATED = "sim"


class DemoClient(Client):
    """A client of one service; every method is one step of the demo."""

    def __init__(self, url: str) -> None:
        """Make a client of the service at a base URL."""
        super().__init__(url, timeout_s=120.0)

    def create_thesis_device(self) -> None:
        """Create the four cameras of the thesis's Figure 5.9, whose readings are posted."""
        sensors = [
            {
                "name": scale.name,
                "pixels": scale.geometry.pixels,
                "pitch_um": scale.pitch_mm * 1000.0,
            }
            for scale in DFW_V500
        ]
        device = {
            "id": THESIS_DEVICE,
            "title": "Two Sony DFW-V500 at four places, thesis Figure 5.9",
            "source": {"kind": "external", "sensors": sensors},
        }
        self.request("POST", "/api/v1/devices", body=device)

    def calibrate_thesis_frame(self, number: str) -> dict[str, Any]:
        """Submit a measured frame as a calibration: ``"5.3"`` or ``"5.4"``."""
        test = load_test(number)
        points = [
            {
                "name": f"LED {index + 1}",
                "position_mm": position.tolist(),
                "readings": {
                    scale.name: float(scale.to_px(readings[sensor]))
                    for sensor, scale in enumerate(DFW_V500)
                },
            }
            for index, (position, readings) in enumerate(
                zip(test.points_mm, test.readings_mm, strict=True)
            )
        ]
        return self._post_calibration(THESIS_DEVICE, points, f"Test {number} as measured")

    def _post_calibration(
        self, device: str, points: list[dict[str, Any]], note: str
    ) -> dict[str, Any]:
        # As the tests were evaluated: few points, no distortion.
        plain = {"distortion": "none", "labels": "off"}
        body = {"device_id": device, "points": points, "note": note, **plain}
        calibration: dict[str, Any] = self.request("POST", "/api/v1/calibrations", body=body)
        return calibration

    def show(self, scene: dict[str, Any]) -> None:
        """Let the simulated device show a scene, from its start."""
        source = {"kind": "simulated", "settings": {"scene": scene}}
        self.request("PATCH", f"/api/v1/devices/{SIMULATED}", body={"source": source})
        self.start_device(SIMULATED)

    def stream_url(self, content: str) -> str:
        """Return the URL of the simulated device's stream."""
        return f"{self._server.stream_url}?device_id={SIMULATED}&content={content}"

    def observe_frame(
        self, seconds: float, progress: Callable[[float], None]
    ) -> dict[int, dict[str, tuple[float, float]]]:
        """Average the peaks of each strobed marker.

        Returns:
            By marker and sensor: mean position and its standard deviation [px].
        """
        readings: dict[int, dict[str, list[_Reading]]] = defaultdict(lambda: defaultdict(list))
        start = None
        for message, now in receive(self.stream_url("peaks"), seconds):
            start = start or now
            if message["type"] != "frame":
                continue
            brightest: dict[str, _Reading] = {}
            for peak in message["peaks"]:
                reading = _Reading(peak["amplitude"], peak["position_px"], peak["sigma_px"])
                brightest[peak["sensor"]] = max(brightest.get(peak["sensor"], reading), reading)
            for sensor, reading in brightest.items():
                readings[message["marker"]][sensor].append(reading)
            progress((now - start) / 1e9)
        return {
            marker: {name: _average(some) for name, some in sensors.items() if len(some) > 3}
            for marker, sensors in sorted(readings.items())
        }

    def calibrate_simulated(
        self, frame_mm: Array, observed: dict[int, dict[str, tuple[float, float]]]
    ) -> dict[str, Any]:
        """Calibrate the simulated device with the observed frame and activate the result."""
        points = [
            {
                "name": f"marker {marker}",
                "position_mm": frame_mm[marker].tolist(),
                "readings": {
                    sensor: {"position_px": position, "sigma_px": sigma}
                    for sensor, (position, sigma) in sensors.items()
                },
            }
            for marker, sensors in observed.items()
        ]
        calibration = self._post_calibration(SIMULATED, points, "simulated calibration frame")
        self.activate_calibration(calibration["id"])
        return calibration

    def stream_bar(self, seconds: float, progress: Callable[[float], None]) -> "BarStream":
        """Receive the points of the rotating bar."""
        stream = BarStream([], [], [], [], [], [], 0)
        for message, now in receive(self.stream_url("points"), seconds):
            if message["type"] == "missed":
                stream.missed += message["messages"]
            if message["type"] != "frame":
                continue
            stream.sequence.append(message["sequence"])
            stream.latency_ns.append(now - message["exposure_ns"])
            stream.exposure_ns.append(message["exposure_ns"])
            time_s = (stream.exposure_ns[-1] - stream.exposure_ns[0]) / 1e9
            progress(time_s)
            for point in message["points"]:
                stream.marker.append(point["marker"])
                stream.time_s.append(time_s)
                stream.position_mm.append(point["position_mm"] or [np.nan] * 3)
        return stream


class _Reading(NamedTuple):
    """One peak, the brightest greatest."""

    amplitude: float
    position_px: float
    sigma_px: float


def _average(readings: list[_Reading]) -> tuple[float, float]:
    """Return the mean position of a still marker and its standard deviation [px].

    Noise averages out. What the stated deviation has beyond the scatter is the estimator's
    error within a pixel: the marker is still, so that part is the same in every reading.
    """
    _, positions, sigmas = (np.array(column) for column in zip(*readings, strict=True))
    scatter = positions.var(ddof=1)
    fixed = max(float((sigmas**2).mean() - scatter), 0.0)
    return float(positions.mean()), float(np.sqrt(fixed + scatter / len(positions)))


@dataclass
class BarStream:
    """Received frames and points of the rotating bar."""

    sequence: list[int]
    latency_ns: list[int]
    exposure_ns: list[int]
    marker: list[int]
    time_s: list[float]
    position_mm: list[list[float]]
    missed: int

    def ends(self) -> tuple[Array, Array, Array]:
        """Return times (N,) and both ends (N, 3) at them.

        The markers are strobed in turn; the second's position is interpolated to the times of
        the first, which between 2 ms at half a turn per second is exact to a nanometre.
        """
        marker, time = np.array(self.marker), np.array(self.time_s)
        position = np.array(self.position_mm)
        good = np.isfinite(position[:, 0])
        first, second = good & (marker == 0), good & (marker == 1)
        low, high = time[second].min(), time[second].max()
        first &= (time >= low) & (time <= high)
        other = np.column_stack(
            [np.interp(time[first], time[second], position[second, axis]) for axis in range(3)]
        )
        return time[first], position[first], other
