"""Counters of one device session: latencies by class, pose statuses by tool."""

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field
from threading import Lock
from typing import Final

from compute.pose.tool_pose import PoseStatus, ToolPose

BOUNDS_S: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Upper bounds of the classes [s]; one more, without a bound, follows."""


@dataclass(frozen=True)
class LatencyCounts:
    """Latencies by class.

    Args:
        counts: batches in each class of BOUNDS_S, and in the one behind it.
        sum_s: of all latencies [s].
    """

    counts: tuple[int, ...] = (0,) * (len(BOUNDS_S) + 1)
    sum_s: float = 0.0


class LatencyHistogram:
    """Counted by one thread, read by any; a lock would cost more than the counting."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def count(self, latency_s: float) -> None:
        """Count a batch; a clock that was set back makes no negative latency."""
        latency_s = max(latency_s, 0.0)
        self._counts[bisect_left(BOUNDS_S, latency_s)] += 1
        self._sum_s += latency_s

    def counts(self) -> LatencyCounts:
        """Return what was counted so far."""
        return LatencyCounts(tuple(self._counts), self._sum_s)


@dataclass(frozen=True)
class ToolCounts:
    """What was counted of one tool.

    Args:
        frames: frames by the status of its pose.
        newest_ns: exposure of the newest frame with a pose of it that is OK, on the host's clock
            [ns]; None: there was none.
    """

    frames: dict[PoseStatus, int] = field(default_factory=dict)
    newest_ns: int | None = None


class PoseCounters:
    """Counted by the compute thread, read by any; tools that are gone are forgotten."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._frames: dict[str, dict[PoseStatus, int]] = {}
        self._newest_ns: dict[str, int] = {}

    def count(self, poses: Iterable[ToolPose]) -> None:
        """Count the poses of a batch."""
        with self._lock:
            for pose in poses:
                frames = self._frames.setdefault(pose.tool, {})
                frames[pose.status] = frames.get(pose.status, 0) + 1
                if pose.valid:
                    self._newest_ns[pose.tool] = pose.exposure_ns

    def keep(self, tools: Iterable[str]) -> None:
        """Forget all other tools: their names must not pile up."""
        with self._lock:
            kept = set(tools)
            self._frames = {name: one for name, one in self._frames.items() if name in kept}
            self._newest_ns = {name: at for name, at in self._newest_ns.items() if name in kept}

    def counts(self) -> dict[str, ToolCounts]:
        """Return what was counted so far, by tool."""
        with self._lock:
            return {
                name: ToolCounts(dict(frames), self._newest_ns.get(name))
                for name, frames in self._frames.items()
            }
