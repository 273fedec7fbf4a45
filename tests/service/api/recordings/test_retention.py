"""Retention of recordings: what is over a limit is deleted and audited, what is held is kept."""

import os
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import update

from service.api.recordings.retention import RecordingRetention, RetentionLimits
from service.application.app import create_app
from service.database.models import RunRow
from service.settings import Settings
from tests.service.api.recordings.test_recordings_api import write
from tests.service.fake_pipeline import FakePipeline, TestClient

NOW = datetime(2026, 11, 24, 12, tzinfo=UTC)
DAY = timedelta(days=1)


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    with TestClient(create_app(Settings(data_dir=tmp_path), FakePipeline())) as client:
        yield client


def put(client: TestClient, tmp_path: Path, name: str, age: timedelta) -> Path:
    path = tmp_path / "recordings" / name
    write(path, 20)
    changed = (NOW - age).timestamp()
    os.utime(path, (changed, changed))
    return path


def retention(client: Any, now: datetime = NOW, **limits: Any) -> RecordingRetention:
    state = client.app.state
    return RecordingRetention(
        state.recordings, state.database, RetentionLimits(**limits), lambda: now
    )


def test_check_age_older_ones_are_deleted_and_audited(client: TestClient, tmp_path: Path) -> None:
    old = put(client, tmp_path, "old.h5", 8 * DAY)
    young = put(client, tmp_path, "young.h5", 6 * DAY)
    size = old.stat().st_size
    kept = retention(client, max_age=7 * DAY)
    kept.check()
    assert (old.exists(), young.exists()) == (False, True)
    assert (kept.state.deleted, kept.state.deleted_bytes) == (1, size)
    [entry] = client.get("/api/v1/audit", params={"object_kind": "recording"}).json()["items"]
    assert (entry["object_id"], entry["operation"]) == ("old.h5", "recording-retention")
    assert entry["actor"]["kind"] == "service"
    assert entry["before"]["size_bytes"] == size
    assert "older than 7 days" in entry["before"]["reason"]
    # Time goes on, and with it the next one's turn comes.
    later = retention(client, NOW + 2 * DAY, max_age=7 * DAY)
    later.check()
    assert not young.exists()


@pytest.mark.slow
def test_check_size_oldest_go_first_until_it_fits(client: TestClient, tmp_path: Path) -> None:
    paths = [put(client, tmp_path, f"{age}.h5", age * DAY) for age in (4, 3, 2, 1)]
    size = paths[0].stat().st_size
    kept = retention(client, max_total_bytes=2 * size)
    kept.check()
    assert [path.exists() for path in paths] == [False, False, True, True]
    assert kept.state.total_bytes == 2 * size


def test_check_size_recent_ones_are_kept(client: TestClient, tmp_path: Path) -> None:
    recent = put(client, tmp_path, "recent.h5", timedelta(minutes=59))
    old = put(client, tmp_path, "old.h5", timedelta(minutes=61))
    retention(client, max_total_bytes=1).check()
    assert (recent.exists(), old.exists()) == (True, False)


def test_check_without_limits_deletes_nothing(client: TestClient, tmp_path: Path) -> None:
    old = put(client, tmp_path, "old.h5", 5000 * DAY)
    retention(client).check()
    assert old.exists()


def test_check_replayed_recording_is_held(client: TestClient, tmp_path: Path) -> None:
    held = put(client, tmp_path, "held.h5", 30 * DAY)
    source = {"kind": "replay", "recording_id": "held.h5"}
    body = {"id": "tape", "title": "Again", "source": source}
    assert client.post("/api/v1/devices", json=body).status_code == 201
    kept = retention(client, max_age=DAY)
    kept.check()
    assert held.exists()
    assert kept.state.held == ("held.h5",)
    assert kept.state.deleted == 0
    # What was not done is not in the audit log.
    query = {"object_kind": "recording"}
    assert client.get("/api/v1/audit", params=query).json()["items"] == []
    assert client.delete("/api/v1/devices/tape").status_code == 204
    kept.check()
    assert not held.exists()


def test_check_recording_of_open_run_is_held(client: Any, tmp_path: Path) -> None:
    held = put(client, tmp_path, "held.h5", 30 * DAY)
    row = RunRow(
        id="r1", kind="export", device_id="sim", state="queued", progress=0.0, stage="",
        request={"recording_id": "held.h5"}, created_at=NOW, owner="elsewhere",
    )  # fmt: skip
    with client.app.state.database.write() as session:
        session.add(row)
    kept = retention(client, max_age=DAY)
    kept.check()
    assert held.exists()
    refused = client.delete("/api/v1/recordings/held.h5")
    assert refused.json()["type"] == "/problems/recording-in-use"
    assert refused.json()["context"]["referrers"] == {"runs": ["r1"]}
    assert 'read by run "r1"' in refused.json()["detail"]
    with client.app.state.database.write() as session:
        session.execute(update(RunRow).values(state="succeeded"))
    kept.check()
    assert not held.exists()


def test_check_unreadable_file_is_left_to_a_person(client: TestClient, tmp_path: Path) -> None:
    path = tmp_path / "recordings" / "thesis.h5"
    path.write_text("no recording", encoding="utf-8")
    os.utime(path, (0, 0))
    kept = retention(client, max_age=DAY)
    kept.check()
    assert path.exists()
    assert kept.state.held == ("thesis.h5",)


def test_check_database_down_deletes_nothing(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What cannot be written into the audit log stays."""
    old = put(client, tmp_path, "old.h5", 8 * DAY)
    kept = retention(client, max_age=DAY)

    def broken() -> None:
        from service.problems.errors import NotReady

        raise NotReady("the database does not answer")

    monkeypatch.setattr(client.app.state.database, "write", broken)
    kept.check()
    assert old.exists()
    assert kept.state.held == ("old.h5",)


def test_rest_and_metrics_show_limits_and_what_was_done(tmp_path: Path) -> None:
    settings = Settings(
        data_dir=tmp_path, recording_max_age_days=7.0, recording_max_total_bytes=2**30
    )
    (tmp_path / "recordings").mkdir()
    write(tmp_path / "recordings" / "old.h5", 20)
    os.utime(tmp_path / "recordings" / "old.h5", (0, 0))
    with TestClient(create_app(settings, FakePipeline())) as client:
        client.app.state.retention.check()
        document = client.get("/api/v1/recording-retention").json()
        metrics = client.get("/metrics").text
    assert document["max_age_s"] == 7 * 86400.0
    assert document["max_total_bytes"] == 2**30
    assert document["held_recording_ids"] == []
    assert document["deleted_recordings"] == 1
    assert "lumiline_recordings_deleted_total 1.0" in metrics
    assert "lumiline_recordings_held 0.0" in metrics


@pytest.mark.parametrize(
    ("name", "value"),
    [("recording_max_age_days", 0), ("recording_max_age_days", -1),
     ("recording_max_total_bytes", 5)],
)  # fmt: skip
def test_settings_that_would_delete_everything_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        Settings(**{name: value})
