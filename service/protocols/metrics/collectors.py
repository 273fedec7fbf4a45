"""Collectors of metrics: devices, streams, database and recordings, read when Prometheus asks."""

import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import accumulate
from typing import Any, Final, TypeVar, get_args

from prometheus_client import Metric
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    SummaryMetricFamily,
)
from prometheus_client.registry import Collector
from sqlalchemy import func, select

from compute.pose.rigid_body import PoseStatus
from service.api.recordings.recording_manager import RecordingManager
from service.api.recordings.retention import RecordingRetention
from service.api.webhooks.dispatcher import WebhookDispatcher
from service.database.engine import Database
from service.database.models import RunRow
from service.jobs.run_manager import BOUNDS_S, DurationHistogram
from service.jobs.store import STATES, Kind
from service.pipeline import device_session
from service.pipeline.device_status import DeviceState
from service.pipeline.interface import Pipeline, StationState
from service.pipeline.stage_latency import Stage
from service.problems.errors import NotReady
from service.protocols.stream.hub import Hub

Family = TypeVar("Family", CounterMetricFamily, GaugeMetricFamily)
Labelled = Iterable[tuple[tuple[str, ...], float]]
"""Values, each behind those of its labels."""
Members = tuple[tuple[str, str, str], ...]
"""Name, text and member of an object of several metrics; see ``members_of``."""

_FRAMES: Final[Members] = (
    ("frames_received", "Frames received from the device's driver.", "frames_received"),
    ("frames_processed", "Frames that were published to streams.", "frames_processed"),
    (
        "frames_lost",
        "Exposures missing in the device's sequence numbers.",
        "frames_lost",
    ),
    (
        "frames_dropped_compute",
        "Frames dropped in front of the compute thread, which did not keep up.",
        "frames_dropped_compute",
    ),
    (
        "frames_not_tracked",
        "Frames in which markers and tools were not tracked, as the compute thread was behind.",
        "frames_not_tracked",
    ),
)
_LINKS: Final[Members] = (
    ("link_received_bytes", "Bytes that came over the link.", "received_bytes"),
    (
        "link_frames_garbled",
        "Messages thrown away: damaged, cut short, or of another protocol.",
        "frames_garbled",
    ),
    (
        "link_frames_incomplete",
        "Exposures of which parts were missing, thrown away.",
        "frames_incomplete",
    ),
    ("link_reconnects", "How often the device came back.", "reconnects"),
    ("link_clock_restarts", "How often the device's clock began anew.", "clock_restarts"),
)
_STREAMS: Final[Members] = (
    ("stream_messages", "Messages that streams were given to send.", "next"),
    (
        "stream_messages_missed",
        "Messages that clients were told to have missed, of all clients together.",
        "missed",
    ),
)
_STATIONS: Final[Members] = (
    (
        "station_restarts",
        "How often the process that its devices belong to was lost and started again.",
        "restarts",
    ),
    (
        "station_messages_missed",
        "Messages of its bus that were lost before they were read.",
        "messages_missed",
    ),
    ("station_cpu_seconds", "Computing time of it.", "cpu_s"),
)
_RECORDINGS: Final[Members] = (
    ("recording_written_bytes", "Bytes written to recordings.", "size_bytes"),
    ("recording_frames_written", "Frames that are safe in recordings.", "frames_written"),
    (
        "recording_frames_dropped_writer",
        "Frames missing in recordings because their writer did not keep up.",
        "frames_dropped_writer",
    ),
    (
        "recordings_failed",
        "Recordings that ended because they could not be written.",
        "failed",
    ),
)


def _family(
    kind: type[Family], name: str, text: str, values: Labelled, labels: tuple[str, ...]
) -> Family:
    family = kind(f"lumiline_{name}", text, labels=labels)
    for label, value in values:
        family.add_metric(label, value)
    return family


def counter(
    name: str, text: str, values: Labelled, labels: tuple[str, ...] = ("device",)
) -> CounterMetricFamily:
    """Return a counter; ``name`` without the ``_total`` that it gets."""
    return _family(CounterMetricFamily, name, text, values, labels)


def gauge(
    name: str, text: str, values: Labelled, labels: tuple[str, ...] = ("device",)
) -> GaugeMetricFamily:
    """Return a gauge."""
    return _family(GaugeMetricFamily, name, text, values, labels)


def single(name: str, text: str, value: float) -> GaugeMetricFamily:
    """Return a gauge of one value, without labels."""
    return gauge(name, text, [((), value)], ())


def members_of(
    members: Members,
    objects: Mapping[tuple[str, ...], Any],
    labels: tuple[str, ...] = ("device",),
    prefix: str = "",
) -> Iterator[Metric]:
    """Yield a counter for each of some members of objects, by their labels."""
    for name, text, member in members:
        values = ((label, getattr(one, member)) for label, one in objects.items())
        yield counter(f"{prefix}{name}", text, values, labels)


def histogram(
    name: str,
    text: str,
    labels: tuple[str, ...],
    bounds: tuple[float, ...],
    values: Mapping[tuple[str, ...], tuple[tuple[int, ...], float]],
) -> HistogramMetricFamily:
    """Return a histogram of values by labels: counts of each class and behind it, and the sum."""
    family = HistogramMetricFamily(f"lumiline_{name}", text, labels=labels)
    edges = (*map(repr, bounds), "+Inf")
    for label, (counts, total) in values.items():
        running = map(float, accumulate(counts))
        family.add_metric(label, list(zip(edges, running, strict=True)), total)
    return family


def stage_summary(
    timed: Mapping[str, tuple[int, Mapping[Stage, float]]],
) -> SummaryMetricFamily:
    """Return the latency by stage, from frames that were timed and their time in each stage."""
    family = SummaryMetricFamily(
        "lumiline_frame_stage_seconds",
        "Time of one frame a second in each stage, from its exposure until streams have it.",
        labels=("device", "stage"),
    )
    for device, (count, stages) in timed.items():
        for stage, total in stages.items():
            family.add_metric((device, stage), count, total)
    return family


def _by_device(objects: Mapping[str, Any]) -> dict[tuple[str, ...], Any]:
    return {(name,): one for name, one in objects.items()}


class LiveCollector(Collector):
    """Reads the pipeline's counters, which begin anew with a device's start."""

    def __init__(self, live: Pipeline, hub: Hub) -> None:
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
                for state in get_args(DeviceState)
            ),
            ("device", "state"),
        )
        yield from members_of(_FRAMES, _by_device(statuses))
        yield gauge(
            "bad_pixels",
            "Pixels that frames have shown to be bad since the device's start; they are masked.",
            (((name,), float(len(status.bad_pixels))) for name, status in statuses.items()),
        )
        links = {name: status.link for name, status in statuses.items() if status.link is not None}
        yield gauge(
            "link_connected",
            "1 when frames come over the device's link, 0 when it is silent, garbled or "
            "disconnected.",
            (((name,), float(link.state == "connected")) for name, link in links.items()),
        )
        yield from members_of(_LINKS, {(name,): link.counters for name, link in links.items()})
        yield histogram(
            "batch_latency_seconds",
            "From the exposure of the oldest frame of a batch until streams have the batch.",
            ("device",),
            device_session.BOUNDS_S,
            _by_device(self._live.latencies()),
        )
        yield stage_summary(self._live.stage_latencies())
        yield single(
            "compute_busy_seconds",
            "How long the compute thread is at what it has in hand; 0 when it waits.",
            self._live.busy_s,
        )
        yield from self._station()
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
        logs = self._hub.logs()
        clients = (((name,), self._hub.subscribers(name)) for name in logs)
        yield gauge("stream_clients", "Connected streams.", clients)
        yield from members_of(_STREAMS, _by_device(logs))
        yield gauge(
            "stream_messages_kept",
            "Messages that are kept for clients which are behind or come back.",
            (((name,), log.message_count) for name, log in logs.items()),
        )

    def _station(self) -> Iterator[Metric]:
        station = next((one for one in self._live.stations if one.name is None), None)
        counts: list[tuple[str, str, float]] = [
            (
                "station_restarts",
                "How often the process that devices belong to was lost and started again.",
                station.restarts if station else 0,
            ),
            (
                "station_messages_missed",
                "Messages of its bus that were overwritten before they were read.",
                station.messages_missed if station else 0,
            ),
        ]
        if station is not None:
            counts.append(("station_cpu_seconds", "Computing time of it.", station.cpu_s))
            yield single(
                "station_memory_bytes", "Resident memory of it.", float(station.memory_bytes)
            )
        for name, what, value in counts:
            yield counter(name, what, (((), float(value)),), ())
        far: dict[tuple[str, ...], StationState] = {
            (one.name,): one for one in self._live.stations if one.name is not None
        }
        if far:
            yield from self._far_stations(far)

    def _far_stations(self, far: Mapping[tuple[str, ...], StationState]) -> Iterator[Metric]:
        """Yield those of stations on other machines; without a bus there are none."""
        yield from members_of(_STATIONS, far, ("station",), "remote_")
        values: tuple[tuple[str, str, Callable[[StationState], float | None]], ...] = (
            ("station_memory_bytes", "Resident memory of it.", lambda one: one.memory_bytes),
            (
                "station_up",
                "1 where it answers, 0 where it is lost or starts again.",
                lambda one: float(one.state in ("running", "limited")),
            ),
            (
                "station_round_trip_seconds",
                "A question to it over the bus, and its answer.",
                lambda one: one.round_trip_s,
            ),
        )
        for name, what, value in values:
            found = ((label, value(one)) for label, one in far.items())
            labelled = [(label, float(one)) for label, one in found if one is not None]
            yield gauge(f"remote_{name}", what, labelled, ("station",))

    def _tools(self) -> Iterator[Metric]:
        tools = {
            (device, tool): counts
            for device, tools in self._live.pose_counts().items()
            for tool, counts in tools.items()
        }
        yield counter(
            "tool_frames",
            "Frames by what the pose of a tool was worth in them: only OK is one to use.",
            (
                ((*tool, status.value), counts.frames.get(status, 0))
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
                (tool, max(0.0, (now_ns - counts.newest_ns) * 1e-9))
                for tool, counts in tools.items()
                if counts.newest_ns is not None
            ),
            ("device", "tool"),
        )


class DatabaseCollector(Collector):
    """Metrics of the database: whether it answers, and its runs."""

    def __init__(self, database: Database, durations: DurationHistogram) -> None:
        self._database = database
        self._durations = durations

    def collect(self) -> Iterator[Metric]:
        """Yield what there is; without an answer no counts of runs, but that there was none."""
        counts: dict[tuple[str, str], int] | None = None
        query = select(RunRow.kind, RunRow.state, func.count()).group_by(RunRow.kind, RunRow.state)
        with suppress(NotReady), self._database.read() as session:  # logged there
            counts = {(kind, state): count for kind, state, count in session.execute(query)}
        yield single("database_up", "1 when the database answers.", float(counts is not None))
        if counts is not None:
            yield gauge(
                "runs",
                "Runs by kind and state, until they are deleted.",
                (
                    ((kind, state), counts.get((kind, state), 0))
                    for kind in get_args(Kind)
                    for state in STATES
                ),
                ("kind", "state"),
            )
        yield histogram(
            "run_duration_seconds",
            "Time from a run's start to its end on this server, by kind and how it ended.",
            ("kind", "state"),
            BOUNDS_S,
            self._durations.counts(),
        )


class RecordingsCollector(Collector):
    """Recordings that are being written, and the disk that they lie on."""

    def __init__(self, recordings: RecordingManager, retention: RecordingRetention) -> None:
        self._recordings = recordings
        self._retention = retention

    def collect(self) -> Iterator[Metric]:
        """Yield what there is."""
        written = self._recordings.written()
        yield gauge(
            "recordings_open",
            "Recordings that are being written.",
            (((name,), counts.open) for name, counts in written.items()),
        )
        yield from members_of(_RECORDINGS, _by_device(written))
        kept = self._retention.state
        yield counter(
            "recordings_deleted", "Recordings deleted for their age, or for all recordings' size.",
            [((), kept.deleted)], (),
        )  # fmt: skip
        yield single(
            "recordings_held",
            "Recordings over a limit of age or size that are kept, as something refers to them or "
            "they are unreadable.",
            len(kept.held),
        )
        with suppress(OSError):
            free = shutil.disk_usage(self._recordings.library.folder).free
            yield single("recordings_free_bytes", "Free bytes on the disk of recordings.", free)


class WebhooksCollector(Collector):
    """Deliveries of webhooks."""

    def __init__(self, webhooks: WebhookDispatcher) -> None:
        self._webhooks = webhooks

    def collect(self) -> Iterator[Metric]:
        """Yield what there is."""
        states = self._webhooks.states()
        for name, text, member in (
            ("delivered", "Events that a webhook's receiver took.", "events_delivered"),
            ("failed", "Events given up after the last attempt.", "events_failed"),
            ("dropped", "Events dropped because too many waited.", "events_dropped"),
        ):
            values = (((key,), getattr(state, member)) for key, state in states.items())
            yield counter(f"webhook_events_{name}", text, values, ("webhook",))
