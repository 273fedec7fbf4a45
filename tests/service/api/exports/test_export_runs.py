"""Exports over REST: a run makes the file that the command line makes; kept, found, deleted."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from hardware.recording.reader import RecordingReader
from service.api.exports.formats import write_export
from service.api.exports.from_recording import table_from_recording
from service.api.exports.repository import ExportRepository
from service.api.runs.examples import NEW_MAPPING_RUNS
from service.api.runs.kinds import export as task
from service.settings import Settings
from tests.service.api.exports.test_from_stream_and_recording import (
    MARKERS,
    PROBE,
    Taken,
    recording,
)
from tests.service.api.exports.test_from_stream_and_recording import taken as taken
from tests.service.api.runs.in_process_worker import use_in_process_worker
from tests.service.api.runs.test_runs import wait, wait_until

API = "/api/v1"
TOOL = {
    "id": "probe", "device_id": "sim", "title": "Probe", "markers_mm": MARKERS,
    "tip_mm": PROBE.tip_mm,
}  # fmt: skip


@pytest.fixture
def walk(sqlite_settings: Settings, sqlite_client: Any, taken: Taken) -> Path:
    """A recording in the folder, and the tool that is in it."""
    folder = sqlite_settings.folders.recordings / "ward"
    folder.mkdir(parents=True)
    answer = sqlite_client.post(f"{API}/tools", json=TOOL)
    assert answer.status_code == 201, answer.text
    return recording(folder / "walk.h5", taken, lines=False, results=True)


def post(client: Any, **members: Any) -> Any:
    body = {"id": "r", "device_id": "sim", "recording_id": "ward/walk.h5", "format": "csv"}
    return client.post(f"{API}/runs/export", json=body | members)


def ended(client: Any, **members: Any) -> Any:
    answer = post(client, **members)
    assert answer.status_code == 202, answer.text
    run = answer.json()["id"]
    assert answer.headers["location"] == f"{API}/runs/{run}"
    return wait(client, run)


def code(answer: Any) -> tuple[int, str]:
    return answer.status_code, answer.json()["type"].rpartition("/")[2]


@pytest.mark.slow
def test_it_makes_what_the_command_line_makes(
    sqlite_client: Any, walk: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    use_in_process_worker(monkeypatch)
    run = ended(sqlite_client, result_id="walk")
    assert (run["state"], run["problem"], run["kind"]) == ("succeeded", None, "export")
    assert run["result_path"] == f"{API}/exports/walk"
    with RecordingReader(walk) as reader:
        write_export(table_from_recording(reader, [PROBE]), tmp_path / "same.csv")
    expected = (tmp_path / "same.csv").read_bytes()
    assert b"tool,probe,OK" in expected
    whole = sqlite_client.get(f"{run['result_path']}/file")
    assert whole.content == expected
    assert whole.headers["content-type"].startswith("text/csv")
    assert whole.headers["content-disposition"] == 'attachment; filename="walk.csv"'
    rest = {"Range": "bytes=100-", "If-Range": whole.headers["etag"]}
    part = sqlite_client.get(f"{run['result_path']}/file", headers=rest)
    assert (part.status_code, part.content) == (206, expected[100:])
    about = sqlite_client.get(run["result_path"]).json()
    assert about | {"created_at": None} == {
        "id": "walk", "format": "csv", "file_name": "walk.csv", "media_type": "text/csv",
        "size_bytes": len(expected), "created_at": None, "run_id": "r", "device_id": "sim",
        "recording_id": "ward/walk.h5", "gateway": None,
    }  # fmt: skip
    assert sqlite_client.get(f"{API}/exports").json()["items"] == [about]
    # The run may go, and what it made stays until it is deleted.
    assert sqlite_client.delete(f"{API}/runs/r").status_code == 204
    assert sqlite_client.get(run["result_path"]).json() == about | dict.fromkeys(
        ("run_id", "device_id", "recording_id")
    )
    assert sqlite_client.delete(run["result_path"]).status_code == 204
    assert code(sqlite_client.get(run["result_path"])) == (404, "unknown-export")
    assert code(sqlite_client.get(f"{run['result_path']}/file")) == (404, "unknown-export")
    assert code(sqlite_client.delete(run["result_path"])) == (404, "unknown-export")
    assert walk.exists()
    told = sqlite_client.get(f"{API}/audit", params={"operation": "delete-export"}).json()["items"]
    assert [(one["object_kind"], one["object_id"], one["outcome"]) for one in told] == [
        ("export", "walk", "done")
    ]


@pytest.mark.slow
def test_every_format(sqlite_client: Any, walk: Path, monkeypatch: pytest.MonkeyPatch):
    use_in_process_worker(monkeypatch)
    for kind, media_type, begins in (
        ("c3d", "application/octet-stream", b"\x02P"),
        ("trc", "text/tab-separated-values", b"PathFileType"),
        ("parquet", "application/vnd.apache.parquet", b"PAR1"),
        ("igs.mha", "application/octet-stream", b"ObjectType"),
    ):
        identity = kind.replace(".", "-")
        run = ended(sqlite_client, id=identity, format=kind)
        assert run["result_path"] == f"{API}/exports/{identity}", run["problem"]
        found = sqlite_client.get(f"{run['result_path']}/file")
        assert found.content.startswith(begins)
        assert found.headers["content-type"].partition(";")[0] == media_type
        assert f'filename="{identity}.{kind}"' in found.headers["content-disposition"]


def test_tools_are_those_of_when_it_was_posted(
    sqlite_client: Any, walk: Path, monkeypatch: pytest.MonkeyPatch
):
    gate = use_in_process_worker(monkeypatch, closed=True)
    assert post(sqlite_client).status_code == 202
    assert sqlite_client.delete(f"{API}/tools/probe").status_code == 204
    gate.set()
    assert wait(sqlite_client, "r")["state"] == "succeeded"
    assert b"tool,probe,OK" in sqlite_client.get(f"{API}/exports/r/file").content


def test_of_the_tools_those_that_are_wanted_and_with_another_calibration(
    sqlite_client: Any, walk: Path, monkeypatch: pytest.MonkeyPatch
):
    use_in_process_worker(monkeypatch)
    assert ended(sqlite_client, tool_ids=[])["state"] == "succeeded"
    assert b"tool," not in sqlite_client.get(f"{API}/exports/r/file").content
    other = ended(sqlite_client, id="s", format="parquet", calibration_id="sim-nominal")
    assert other["problem"] is None
    assert b"sim-nominal" in sqlite_client.get(f"{API}/exports/s/file").content


def test_what_is_refused(
    sqlite_client: Any, walk: Path, monkeypatch: pytest.MonkeyPatch, sqlite_settings: Settings
):
    use_in_process_worker(monkeypatch, closed=True)
    exports: ExportRepository = sqlite_client.app.state.exports
    exports.folder.mkdir()
    (exports.folder / "taken.trc").write_text("there")
    bar = {"id": "bar", "title": "Bar", "source": {"kind": "simulated"}}
    assert sqlite_client.post(f"{API}/devices", json=bar).status_code == 201
    for members, expected in (
        ({"device_id": "none"}, (404, "unknown-device")),
        ({"recording_id": "none.h5"}, (404, "unknown-recording")),
        ({"recording_id": "../lumiline.sqlite3"}, (422, "invalid-request")),
        ({"format": "xlsx"}, (422, "invalid-request")),
        ({"tool_ids": ["none"]}, (404, "unknown-tool")),
        ({"device_id": "bar", "tool_ids": ["probe"]}, (422, "invalid-parameter")),
        ({"calibration_id": "none"}, (404, "unknown-calibration")),
        ({"table_id": "none"}, (422, "invalid-parameter")),
        ({"calibration_id": "sim-nominal", "table_id": "none"}, (404, "unknown-correction-table")),
        ({"result_id": "taken"}, (409, "export-exists")),
    ):
        assert code(post(sqlite_client, **members)) == expected, members
    monkeypatch.setattr(task, "MAX_FRAMES", 79)
    refused = post(sqlite_client)
    assert code(refused) == (422, "invalid-parameter")
    assert "has 80 frames; 79 are the most" in refused.json()["detail"]
    monkeypatch.undo()
    use_in_process_worker(monkeypatch, closed=True)
    exports.free_bytes = 2**62
    assert code(post(sqlite_client)) == (507, "insufficient-storage")
    exports.free_bytes = 0
    recordings = sqlite_client.app.state.recordings
    monkeypatch.setitem(recordings._starting, "ward/walk.h5", "sim")
    assert code(post(sqlite_client)) == (409, "recording-in-progress")
    monkeypatch.delitem(recordings._starting, "ward/walk.h5")
    # What a run that waits or runs is to make is taken as well, in whatever format.
    assert post(sqlite_client, result_id="mine").status_code == 202
    assert code(post(sqlite_client)) == (409, "run-exists")
    other = post(sqlite_client, id="other", result_id="mine", format="trc")
    assert code(other) == (409, "export-exists")
    # A correction table may be called so.
    mapping = NEW_MAPPING_RUNS["grid"]["value"] | {"result_id": "mine"}
    assert sqlite_client.post(f"{API}/runs/mapping", json=mapping).status_code == 202


def test_of_a_run_that_is_cancelled_nothing_is_left(
    sqlite_client: Any, walk: Path, monkeypatch: pytest.MonkeyPatch
):
    use_in_process_worker(monkeypatch, closed=True)
    assert post(sqlite_client).status_code == 202
    wait(sqlite_client, "r", lambda found: found["state"] == "running")
    exports: ExportRepository = sqlite_client.app.state.exports
    exports.partial_path("r", "csv").write_text("half of it")
    assert sqlite_client.post(f"{API}/runs/r/cancel").json()["state"] == "cancelled"
    wait_until(lambda: not exports.partial_path("r", "csv").exists())
    assert sqlite_client.get(f"{API}/exports").json()["items"] == []


@pytest.mark.slow
def test_what_fails_says_why_and_leaves_nothing(
    sqlite_client: Any, walk: Path, monkeypatch: pytest.MonkeyPatch
):
    gate = use_in_process_worker(monkeypatch, closed=True)
    exports: ExportRepository = sqlite_client.app.state.exports

    def problem(run: str) -> str:
        found = wait(sqlite_client, run)
        assert (found["state"], found["result_path"]) == ("failed", None)
        kind: str = found["problem"]["type"].rpartition("/")[2]
        return kind

    # One run at once: the others are prepared when the first has ended.
    assert post(sqlite_client, id="first", tool_ids=[]).status_code == 202
    assert post(sqlite_client, id="taken").status_code == 202
    for run in ("broken", "gone"):
        shutil.copy(walk, walk.with_name(f"{run}.h5"))
        assert post(sqlite_client, id=run, recording_id=f"ward/{run}.h5").status_code == 202
    (exports.folder / "taken.trc").write_text("there")
    walk.with_name("broken.h5").write_bytes(b"nothing")
    walk.with_name("gone.h5").unlink()
    gate.set()
    assert problem("taken") == "export-exists"
    assert problem("broken") == "invalid-recording"
    assert problem("gone") == "unknown-recording"
    gate.clear()
    for run in ("second", "full"):
        assert post(sqlite_client, id=run, tool_ids=[]).status_code == 202
    exports.free_bytes = 2**62
    gate.set()
    assert problem("full") == "insufficient-storage"
    wait_until(lambda: not list(exports.partial_path("x", "csv").parent.iterdir()))


def test_what_a_killed_server_left_is_deleted_and_what_runs_is_not(tmp_path: Path):
    exports = ExportRepository(tmp_path / "exports")
    exports.sweep(lambda: ())
    exports.partial_path("lost", "igs.mha").write_text("half")
    exports.partial_path("runs", "csv").write_text("half")
    exports.sweep(lambda: ["runs"])
    assert not exports.partial_path("lost", "igs.mha").exists()
    assert exports.partial_path("runs", "csv").exists()
    assert exports.all() == []


def test_a_file_is_kept_once_and_never_overwritten(tmp_path: Path):
    exports = ExportRepository(tmp_path / "exports")
    exports.partial_path("r", "csv").write_text("whole")
    exports.publish("r", "csv", "walk")
    exports.publish("r", "csv", "walk")  # the database did not answer the first time
    (exports.folder / "notes.txt").write_text("not ours")
    (exports.folder / "Not-a-slug.csv").write_text("not ours")
    assert [(one.id, one.size_bytes) for one in exports.all()] == [("walk", 5)]
    exports.partial_path("s", "csv").write_text("other")
    with pytest.raises(Exception, match="exists already"):
        exports.publish("s", "csv", "walk")
    path, _ = exports.find("walk")
    assert path.read_text() == "whole"
    with pytest.raises(Exception, match="is not an id"):
        exports.find("../walk")
