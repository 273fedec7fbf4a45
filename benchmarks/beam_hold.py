"""Benchmark of beam holds at a client: latency, missed and false signals."""

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PERCENTILES: Final = (50.0, 99.0)


STEPS: Final = 2000


@dataclass(frozen=True)
class HoldSignal:
    """A received change of a beam hold.

    Args:
        hold: its id.
        held: whether the beam is held from then on.
        cause: why.
        received_ns: when the message was in the client's hands [ns].
        sequence: number of the frame that it is of; None: of none.
    """

    hold: str
    held: bool
    cause: str
    received_ns: int
    sequence: int | None


@dataclass
class ReceivedSignals:
    """Signals received by two clients: one of changes only, one of every frame.

    Args:
        signals: changes, in order.
        frames: exposure [ns] of each frame by its number.
        shifts: what each frame's hold that tells shifts told [mm], by number.
        missed: messages that the service left out for a client.
    """

    signals: list[HoldSignal] = field(default_factory=list)
    frames: dict[int, int] = field(default_factory=dict)
    shifts: dict[int, tuple[float, ...]] = field(default_factory=dict)
    missed: int = 0


@dataclass(frozen=True)
class Figures:
    """Latencies, missed and false signals of one hold over all movements.

    Args:
        movements: how often the true position left the tolerance.
        already: how often the beam was held then in any case, from before it moved.
        held: how often it was held because of it.
        missed: how often it was not held while the position was out.
        late: of those held, later than the rules' longest gap after the position left it.
        early: of those held, before it left it: on its way, when being out was likely enough.
        false: holds while nothing moved.
        causes: of the holds at movements, by cause.
        false_causes: of those while nothing moved: ``no-data`` where the computer, or the tracking,
            did not keep up.
        latency_ms: from the exposure of the first frame in which the true position is out of
            tolerance to the signal in the client's hands, by percentile, and the largest;
            negative where the beam was held on the way.
        signal_ms: from the exposure of the frame that the signal is of to the client's hands.
    """

    movements: int
    already: int
    held: int
    missed: int
    late: int
    early: int
    false: int
    causes: dict[str, int]
    false_causes: dict[str, int]
    latency_ms: dict[str, float]
    signal_ms: dict[str, float]


def step_us() -> dict[str, float]:
    """Return the CPU time of a monitor's step [us]: for a tool and for four markers, stationary."""
    from compute.pose.beam_hold import (
        BeamHoldLimits,
        MarkerDeviationMonitor,
        PoseDeviationMonitor,
    )
    from compute.transform import Transform

    spread = np.diag([1e-8] * 3 + [1e-3] * 3)
    pose = Transform(np.eye(3), np.array([0.1, 0.0, 1500.0]), spread)
    positions = np.array(
        [[0.0, 0.0, 1500.0], [80.0, 0, 1500.0], [0, 60.0, 1500.0], [20, 15.0, 1540]]
    )
    covariances = np.broadcast_to(1e-3 * np.eye(3), (4, 3, 3))
    limits = BeamHoldLimits(shift_mm=2.0)
    tool, markers = PoseDeviationMonitor(pose, limits), MarkerDeviationMonitor(positions, limits)
    steps: dict[str, Callable[[int], object]] = {
        "tool": lambda time_ns: tool.step(time_ns, pose),
        "markers": lambda time_ns: markers.step(time_ns, positions + 0.05, covariances),
    }
    found = {}
    for name, step in steps.items():
        begin = time.thread_time()
        for number in range(STEPS):
            step(number * 1_000_000)
        found[name] = 1e6 * (time.thread_time() - begin) / STEPS
    return found


def listen(
    url: str, watched_hold: str, seconds: float, progress: Callable[[float], None] | None = None
) -> ReceivedSignals:
    """Receive changes and frames of all holds for some seconds.

    Args:
        url: of the stream of the device, without content.
        watched_hold: the hold whose shifts are kept.
        seconds: how long.
        progress: gets the seconds that have passed.

    Raises:
        RuntimeError: the device does not run.
    """
    import msgpack
    from websockets.sync.client import connect

    heard, ended = ReceivedSignals(), threading.Event()
    failed: list[BaseException] = []

    def frames() -> None:
        try:
            with connect(f"{url}&content=holds&bundle_ms=50", compression=None, max_size=None,
                         max_queue=None) as socket:  # fmt: skip
                while not ended.is_set():
                    _keep(heard, msgpack.unpackb(socket.recv(timeout=10.0)), watched_hold)
        except BaseException as error:  # noqa: BLE001 - told to who waits
            failed.append(error)

    other = threading.Thread(target=frames, daemon=True)
    other.start()
    with connect(f"{url}&content=holds&rate_hz=20", compression=None, max_queue=None) as socket:
        begin = time.monotonic()
        while (passed := time.monotonic() - begin) < seconds and not failed:
            try:
                payload = socket.recv(timeout=10.0)
            except TimeoutError:
                raise RuntimeError("no word of the device came within ten seconds") from None
            now = time.time_ns()
            message = msgpack.unpackb(payload)
            if message["type"] == "hello":
                heard.signals += [
                    HoldSignal(one["hold_id"], one["held"], one["cause"], now, -1)
                    for one in message["holds"]
                ]
            if message["type"] == "hold":
                name, held, cause = message["hold_id"], message["held"], message["cause"]
                heard.signals.append(HoldSignal(name, held, cause, now, message["sequence"]))
            if message.get("state", "running") != "running":
                raise RuntimeError(f"the device is {message['state']}: {message['reason']}")
            if progress is not None:
                progress(passed)
    ended.set()
    other.join(15.0)
    if failed:
        raise RuntimeError(f"the frames could not be heard: {failed[0]}")
    return heard


def _keep(heard: ReceivedSignals, message: dict[str, Any], watched_hold: str) -> None:
    if message["type"] == "missed":
        heard.missed += message["messages"]
    for frame in message.get("frames", ()):
        heard.frames[frame["sequence"]] = frame["exposure_ns"]
        for one in frame["holds"]:
            if one["hold_id"] == watched_hold and one["shift_mm"] is not None:
                heard.shifts[frame["sequence"]] = one["shift_mm"]


def beginning(shifts: dict[int, tuple[float, ...]], truth_mm: Array) -> int:
    """Return the device's phase in its cycle at frame 0: the best fit of the shifts.

    Args:
        shifts: measured, by number of the frame [mm].
        truth_mm: of each frame of the cycle, shape (C, 3) [mm].

    Raises:
        RuntimeError: there are none.
    """
    if not shifts:
        raise RuntimeError("no frame told where the markers are")
    numbers = np.array(list(shifts))
    measured = np.array(list(shifts.values()))
    cycle = len(truth_mm)
    misfit = [
        float(((measured - truth_mm[(numbers + begin) % cycle]) ** 2).sum())
        for begin in range(cycle)
    ]
    return int(np.argmin(misfit))


def summed(
    heard: ReceivedSignals, hold: str, truth_mm: Array, limit_mm: float, late_ms: float, begin: int
) -> Figures:
    """Return the statistics of one hold.

    Args:
        heard: what was heard.
        hold: its id.
        truth_mm: shift of each frame of the device's cycle, shape (C, 3) [mm].
        limit_mm: beyond which it is out of tolerance.
        late_ms: after which a signal is late.
        begin: see ``beginning``.

    Raises:
        RuntimeError: nothing ever left the tolerance.
    """
    size = np.linalg.norm(truth_mm, axis=1)
    numbers = np.array(sorted(heard.frames))
    phase = (numbers + begin) % len(size)
    moved, out = size[phase] > 0.0, size[phase] > limit_mm
    changes = [one for one in heard.signals if one.hold == hold and one.sequence is not None]
    # What holds again for another cause was held already.
    starts = [one for before, one in pairwise(changes) if one.held and not before.held]
    latency, signal = [], []
    causes: Counter[str] = Counter()
    movements = already = 0
    for first, last in _runs(moved):
        outside = np.flatnonzero(out[first:last])
        # One that had begun, or has not ended, while it was heard is none to judge.
        if first == 0 or last == len(numbers) or not len(outside):
            continue
        movements += 1
        begun, ended = int(numbers[first]), int(numbers[last - 1])
        found = next((one for one in starts if begun <= _number(one) <= ended), None)
        if found is None:
            already += _held_at(changes, begun)
            continue
        causes[found.cause] += 1
        due_ns = heard.frames[int(numbers[first + outside[0]])]
        latency.append((found.received_ns - due_ns) * 1e-6)
        exposed = heard.frames.get(_number(found))
        if exposed is not None:
            signal.append((found.received_ns - exposed) * 1e-6)
    if not movements:
        raise RuntimeError("nothing left the tolerance while it was listened to")
    false = Counter(
        one.cause
        for one in starts
        if numbers[0] < _number(one) < numbers[-1] and size[(_number(one) + begin) % len(size)] == 0
    )
    return Figures(
        movements,
        already,
        len(latency),
        movements - already - len(latency),
        sum(one > late_ms for one in latency),
        sum(one < 0.0 for one in latency),
        false.total(),
        dict(causes),
        dict(false),
        _percentiles(latency),
        _percentiles(signal),
    )


def _number(signal: HoldSignal) -> int:
    return -1 if signal.sequence is None else signal.sequence


def _held_at(changes: list[HoldSignal], number: int) -> bool:
    """Return whether the beam was held when the frame of this number was exposed."""
    before = [one for one in changes if _number(one) < number]
    return before[-1].held if before else True


def _runs(true: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first index and end index of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def _percentiles(values: list[float]) -> dict[str, float]:
    if not values:
        return {}
    found = {f"p{p:g}": float(np.percentile(values, p)) for p in PERCENTILES}
    return found | {"max": max(values)}
