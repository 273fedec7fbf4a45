"""LiveCollector: metrics of devices and their streams, read when Prometheus asks."""

import time
from collections.abc import Iterator
from typing import Final, get_args

from prometheus_client import Metric
from prometheus_client.registry import Collector

from compute.pose.rigid_body import PoseStatus
from service.pipeline.device_session import BOUNDS_S
from service.pipeline.device_status import DeviceState, DeviceStatus
from service.pipeline.pipeline_manager import PipelineManager
from service.protocols.metrics.families import Labelled, counter, gauge, histogram, single
from service.protocols.stream.hub import Hub

_STATES: Final[tuple[str, ...]] = get_args(DeviceState)


class LiveCollector(Collector):
    """Reads the pipeline's counters, which begin anew with a device's start.

    Args:
        live: the running devices.
        hub: their streams.
    """

    def __init__(self, live: PipelineManager, hub: Hub) -> None:
        self._live = live
        self._hub = hub

    def collect(self) -> Iterator[Metric]:
        """Yield what there is."""
        statuses = self._live.statuses()
        yield gauge(
            "device_state",
            "1 for the state that a device is in, 0 for the others.",
            (
                ((name, state), float(status.state == state))
                for name, status in statuses.items()
                for state in _STATES
            ),
            ("device", "state"),
        )
        yield from _frames(statuses)
        yield from _links(statuses)
        yield histogram(
            "batch_latency_seconds",
            "From the exposure of the oldest frame of a batch until streams have the batch.",
            ("device",),
            BOUNDS_S,
            {(name,): (had.counts, had.sum_s) for name, had in self._live.latencies().items()},
        )
        yield single(
            "compute_busy_seconds",
            "How long the compute thread is at what it has in hand; 0 when it waits.",
            self._live.busy_s,
        )
        yield from self._tools()
        yield gauge(
            "hold_held",
            "1 where a beam is held, 0 where it may go on.",
            (
                ((device, now.hold_id), float(now.held))
                for device, holds in self._live.holds.all().items()
                for now in holds
            ),
            ("device", "hold"),
        )
        yield from self._streams()

    def _tools(self) -> Iterator[Metric]:
        devices = self._live.pose_counts()
        yield counter(
            "tool_frames",
            "Frames by what the pose of a tool was worth in them: only OK is one to use.",
            (
                ((device, tool, status.value), counts.frames.get(status, 0))
                for device, tools in devices.items()
                for tool, counts in tools.items()
                for status in PoseStatus
            ),
            ("device", "tool", "status"),
        )
        now_ns = time.time_ns()
        yield gauge(
            "tool_pose_age_seconds",
            "Since the exposure of the newest frame in which a tool's pose was OK.",
            (
                ((device, tool), max(0.0, (now_ns - counts.newest_ns) * 1e-9))
                for device, tools in devices.items()
                for tool, counts in tools.items()
                if counts.newest_ns is not None
            ),
            ("device", "tool"),
        )

    def _streams(self) -> Iterator[Metric]:
        logs = self._hub.logs()
        yield gauge(
            "stream_clients",
            "Connected streams.",
            (((name,), self._hub.subscribers(name)) for name in logs),
        )
        yield counter(
            "stream_messages",
            "Messages that streams were given to send.",
            (((name,), log.next) for name, log in logs.items()),
        )
        yield counter(
            "stream_messages_missed",
            "Messages that clients were told to have missed, of all clients together.",
            (((name,), log.missed) for name, log in logs.items()),
        )
        yield gauge(
            "stream_messages_kept",
            "Messages that are kept for clients which are behind or come back.",
            (((name,), log.held) for name, log in logs.items()),
        )


def _frames(statuses: dict[str, DeviceStatus]) -> Iterator[Metric]:
    here = statuses.items()
    yield counter(
        "frames_received",
        "Frames received from the device's driver.",
        (((name,), status.frames) for name, status in here),
    )
    yield counter(
        "frames_processed",
        "Frames that were published to streams.",
        (((name,), status.frames_processed) for name, status in here),
    )
    yield counter(
        "exposures_lost",
        "Exposures missing in the device's sequence numbers.",
        (((name,), status.frames_lost_device) for name, status in here),
    )
    yield counter(
        "frames_dropped",
        "Frames dropped in front of the compute thread, which did not keep up.",
        (((name,), status.frames_dropped_ring) for name, status in here),
    )
    yield counter(
        "frames_not_tracked",
        "Frames in which markers and tools were not followed, as the compute thread was behind.",
        (((name,), status.frames_not_tracked) for name, status in here),
    )


def _links(statuses: dict[str, DeviceStatus]) -> Iterator[Metric]:
    links = {name: status.link for name, status in statuses.items() if status.link is not None}

    def values(member: str) -> Labelled:
        return (((name,), getattr(link.counters, member)) for name, link in links.items())

    yield gauge(
        "link_connected",
        "1 when frames come over the device's link, 0 when it is silent, garbled or disconnected.",
        (((name,), float(link.state == "connected")) for name, link in links.items()),
    )
    yield counter("link_received_bytes", "Bytes that came over the link.", values("bytes_received"))
    yield counter(
        "link_frames_garbled",
        "Messages thrown away: damaged, cut short, or of another protocol.",
        values("frames_garbled"),
    )
    yield counter(
        "link_frames_incomplete",
        "Exposures of which parts were missing, thrown away.",
        values("frames_incomplete"),
    )
    yield counter("link_reconnects", "How often the device came back.", values("reconnects"))
    yield counter(
        "link_clock_restarts", "How often the device's clock began anew.", values("clock_restarts")
    )
