"""PoseCounts: how many frames had a pose of each tool, by its status, and when it last was good."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from threading import Lock

from compute.pose.tool_pose import PoseStatus, ToolPose


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
