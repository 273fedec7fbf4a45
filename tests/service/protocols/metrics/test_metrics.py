"""What Prometheus reads: the format, the names and units, and that figures are the true ones."""

import re
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as open_metrics
from prometheus_client.parser import text_string_to_metric_families as plain

from compute.pose.rigid_body import PoseStatus
from hardware.link import LinkCounters, LinkState
from service.api.recordings.recorder import WriteCounters
from service.database.models import RunRow
from service.jobs.run_manager import DurationHistogram
from service.logs import RequestRecord
from service.pipeline.device_session import BOUNDS_S, LatencyHistogram, ToolCounts
from service.pipeline.device_status import DeviceStatus
from tests.service.fake_pipeline import FakePipeline
from tests.service.test_outage import cut_off

__all__ = ["cut_off"]

BASE_UNITS = {"seconds", "bytes"}
OTHER_UNITS = re.compile(
    r"_(ms|us|ns|milliseconds|minutes|hours|kb|mb|mib|gib|percent|celsius)(_|$)"
)


def read(client: Any) -> dict[str, Any]:
    answer = client.get("/metrics")
    assert answer.status_code == 200
    return {family.name: family for family in plain(answer.text)}


def value(families: dict[str, Any], name: str, **labels: str) -> float:
    found = [
        sample.value
        for family in families.values()
        for sample in family.samples
        if sample.name == name and labels.items() <= sample.labels.items()
    ]
    assert len(found) == 1, (name, labels, found)
    return float(found[0])


@pytest.fixture
def busy(live: FakePipeline, sqlite_client: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A server of which every figure has a value."""
    counters = LinkCounters(
        received_bytes=12345, frames_received=50, frames_garbled=2, reconnects=3
    )
    link = LinkState("garbled", "noise", counters)
    live.states["bar"] = DeviceStatus(
        "running", frames_received=100, frames_lost=7, frames_dropped_compute=5,
        frames_processed=90, link=link, frames_not_tracked=8,
    )  # fmt: skip
    latency = LatencyHistogram()
    for seconds in (0.0004, 0.0011, 0.0012, 99.0, -1.0):
        latency.count(seconds)
    monkeypatch.setattr(live, "latencies", lambda: {"bar": latency.counts()})
    stages = {"reception": 0.5, "waiting": 0.25, "computation": 2.0, "publication": 0.0}
    monkeypatch.setattr(live, "stage_latencies", lambda: {"bar": (4, stages)})
    seen = {PoseStatus.OK: 70, PoseStatus.MISSING: 20}
    tools = {"probe": ToolCounts(seen, time.time_ns()), "lost": ToolCounts({}, None)}
    monkeypatch.setattr(live, "pose_counts", lambda: {"bar": tools})
    app = sqlite_client.app
    written = {
        "bar": WriteCounters(
            open=1, frames_written=80, frames_dropped_writer=4, size_bytes=999, failed=2
        )
    }
    monkeypatch.setattr(app.state.recordings, "written", lambda: written)
    begin = datetime.now(UTC)
    for took_s in (3.0, 40.0):
        app.state.runs.durations.ended(
            RunRow(kind="mapping", state="succeeded", started_at=begin,
                   finished_at=begin + timedelta(seconds=took_s))
        )  # fmt: skip
    live.streams.publish("bar", {"type": "status"})
    live.streams.log("bar").missed = 6
    sqlite_client.get("/api/v1/devices/sim")
    sqlite_client.get("/nowhere/1")
    sqlite_client.get("/nowhere/2")
    return sqlite_client


def test_names_have_their_units_and_counters_end_in_total(busy: Any):
    """The rules of promtool's lint, and of the conventions that it checks."""
    families = read(busy)
    text = busy.get("/metrics").text
    types = dict(re.findall(r"^# TYPE (\S+) (\S+)$", text, re.M))
    assert set(re.findall(r"^# HELP (\S+) .{5}", text, re.M)) == set(types)
    assert len(types) >= 30
    for name, kind in types.items():
        assert re.fullmatch(r"[a-z][a-z0-9_]*", name), name
        assert name.endswith("_total") == (kind == "counter"), name
        assert not OTHER_UNITS.search(name), name
        assert not name.endswith(("_count", "_sum", "_bucket", "_gauge", "_counter")), name
        if kind == "histogram":
            assert name.endswith("_seconds"), name
        for unit in BASE_UNITS:
            if f"_{unit}" in name:
                assert re.search(rf"_{unit}(_total)?$", name), name
    for family in families.values():
        seen = set()
        for sample in family.samples:
            assert {"instance", "job"}.isdisjoint(sample.labels), sample
            key = (sample.name, *sorted(sample.labels.items()))
            assert key not in seen, sample
            seen.add(key)


def test_figures_are_those_of_the_live_side(busy: Any):
    found = read(busy)
    for name, wanted in {
        "frames_received_total": 100,
        "frames_lost_total": 7,
        "frames_dropped_compute_total": 5,
        "frames_not_tracked_total": 8,
        "frames_processed_total": 90,
        "link_received_bytes_total": 12345,
        "link_frames_garbled_total": 2,
        "link_reconnects_total": 3,
        "link_connected": 0,
        "recordings_open": 1,
        "recording_frames_written_total": 80,
        "recording_frames_dropped_writer_total": 4,
        "recording_written_bytes_total": 999,
        "recordings_failed_total": 2,
        "stream_messages_total": 1,
        "stream_messages_missed_total": 6,
        "stream_messages_kept": 1,
        "stream_clients": 0,
        "batch_latency_seconds_count": 5,
    }.items():
        assert value(found, f"lumiline_{name}", device="bar") == wanted, name
    assert value(found, "lumiline_device_state", device="bar", state="running") == 1
    for stage, total in (("reception", 0.5), ("computation", 2.0), ("publication", 0.0)):
        labels = {"device": "bar", "stage": stage}
        assert value(found, "lumiline_frame_stage_seconds_count", **labels) == 4
        assert value(found, "lumiline_frame_stage_seconds_sum", **labels) == total
    assert value(found, "lumiline_device_state", device="bar", state="failed") == 0
    tool = {"device": "bar", "tool": "probe"}
    for status, wanted in (("OK", 70), ("MISSING", 20), ("INVALID", 0)):
        assert value(found, "lumiline_tool_frames_total", **tool, status=status) == wanted
    assert 0.0 <= value(found, "lumiline_tool_pose_age_seconds", **tool) < 3600.0
    with pytest.raises(AssertionError):  # a tool that was never seen is of no age
        value(found, "lumiline_tool_pose_age_seconds", device="bar", tool="lost")
    assert value(found, "lumiline_database_up") == 1
    assert value(found, "lumiline_recordings_free_bytes") > 0
    assert value(found, "process_resident_memory_bytes") > 0
    assert value(found, "lumiline_build_info") == 1
    assert value(found, "lumiline_runs", kind="mapping", state="queued") == 0


def test_histograms_count_up_to_their_count(busy: Any):
    found = read(busy)
    for name in ("lumiline_batch_latency_seconds", "lumiline_run_duration_seconds"):
        buckets = [s.value for s in found[name].samples if s.name.endswith("_bucket")]
        assert buckets == sorted(buckets)
        assert buckets[-1] == value(found, f"{name}_count")
    assert value(found, "lumiline_batch_latency_seconds_bucket", le="0.0005") == 2
    assert value(found, "lumiline_batch_latency_seconds_bucket", le="0.002") == 4
    assert value(found, "lumiline_batch_latency_seconds_bucket", le=repr(BOUNDS_S[-1])) == 4
    assert value(found, "lumiline_run_duration_seconds_sum", kind="mapping") == 43
    assert value(found, "lumiline_run_duration_seconds_bucket", le="5.0") == 1


def test_requests_are_counted_by_the_routes_template(busy: Any):
    found = read(busy)
    name = "lumiline_http_requests_total"
    of_device = {"method": "GET", "route": "/api/v1/devices/{device_id}"}
    assert value(found, name, **of_device, status="2xx") == 1
    assert value(found, "lumiline_http_request_duration_seconds_count", **of_device) == 1
    # Paths that are no route share a series: a scan of them makes no more.
    assert value(found, name, route="none") == 2
    busy.request("BREW", "/nowhere")
    busy.head("/healthz")
    metrics = busy.app.state.metrics
    metrics.request_ended(RequestRecord("1", "websocket", "GET", "/api/v1/stream", 101))
    metrics.request_ended(RequestRecord("2", "http", "GET"))
    found = read(busy)
    assert value(found, name, method="other", route="none") == 1
    assert value(found, name, method="HEAD", route="/healthz", status="2xx") == 1
    assert value(found, name, method="GET", route="none", status="4xx") == 3
    assert value(found, name, method="WEBSOCKET", route="/api/v1/stream", status="1xx") == 1


@pytest.mark.parametrize(
    ("accept", "media_type"),
    [
        ("application/openmetrics-text; version=1.0.0", "application/openmetrics-text"),
        ("text/plain; version=1.0.0", "text/plain"),
        ("text/plain; version=none", "text/plain"),
        ("*/*", "text/plain"),
    ],
)
def test_the_format_is_the_one_asked_for(busy: Any, accept: str, media_type: str):
    answer = busy.get("/metrics", headers={"accept": accept})
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith(media_type)
    parse = open_metrics if "openmetrics" in media_type else plain
    assert len(list(parse(answer.text))) >= 30


def test_a_database_that_does_not_answer_is_told_and_the_rest_is_there(cut_off: Any):
    found = read(cut_off)
    assert value(found, "lumiline_database_up") == 0
    assert "lumiline_runs" not in found
    assert "lumiline_stream_clients" in found


def test_runs_are_counted_as_they_end(tmp_path: Path):
    durations = DurationHistogram()
    begin = datetime(2026, 1, 1, tzinfo=UTC)
    durations.ended(RunRow(kind="mapping", state="failed", started_at=None, finished_at=begin))
    assert durations.counts() == {}
    durations.ended(RunRow(kind="mapping", state="failed", started_at=begin, finished_at=begin))
    assert durations.counts()[("mapping", "failed")][0][0] == 1
