"""Damaged recordings, tables, backups, profiles, tools, calibrations: refused, or read as written.

Recordings are read here by the service; tests/hardware/recording/test_damage.py reads them by the
library.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from compute.errors import LumilineError
from compute.signal.centroid_settings import MIN_PIXELS
from hardware.recording.writer import RecordingWriter
from service.api.correction_tables.hdf5_file import read_table, write_table
from service.api.devices.profiles import profile_text
from service.api.recordings.active_calibration_file import dump_active_calibration
from service.application.app import create_app
from service.application.initial_content import nominal_calibration, seed
from service.backup.backup import back_up
from service.backup.restore import restore
from service.cli import app, tool_files
from service.cli.json_files import DOCUMENT, read_calibration
from service.cli.output import fail
from service.cli.scan_files import read_scans
from service.cli.tracking_files import read_tools
from service.database.engine import Database
from service.database.migration import migrate
from service.pipeline.active_calibration import ActiveCalibration, LiveBadPixel
from service.problems.errors import BackupUnusable
from service.settings import Settings
from tests.damage import FEW_OR_MANY, MANY, damages
from tests.hardware.recording.blocks import block, described
from tests.service.api.correction_tables.tables import content as content_of_table
from tests.service.fake_pipeline import FakePipeline, TestClient

PLANNED = 50


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, range]:
    """A recording with results and two calibrations, one with a table; where these lie in it."""
    path = tmp_path_factory.mktemp("recording") / "whole.h5"
    bad = (LiveBadPixel("vertical", 7, "hot", datetime(2026, 3, 1, tzinfo=UTC)),)
    nominal = nominal_calibration()
    table = write_table(content_of_table("0" * 64))
    sensors = tuple(replace(one, pixels=MIN_PIXELS) for one in described().sensors)
    with RecordingWriter(path, replace(described(), sensors=sensors), results=True) as writer:
        for row, extra in enumerate((
            {"bad_pixels": bad}, {"table_id": "map", "table_file": table, "bad_pixels": 2 * bad}
        )):  # fmt: skip
            active = ActiveCalibration(f"sim-{row}", nominal, **extra)
            assert writer.put_active_calibration(*dump_active_calibration(active)) == row
            frames = block(3 + 16 * row, 16, row)
            lines = np.resize(frames.lines, (16, len(sensors), MIN_PIXELS))
            writer.append_block(replace(frames, lines=lines))
    with h5py.File(path) as file:
        stored = file["active_calibrations/bytes"]
        start = stored.id.get_chunk_info(0).byte_offset
        part = range(start, start + len(stored))
    return path.read_bytes(), part


UNCHANGED = (
    "/api/v1/recordings/damaged.h5/frames?count=64",
    "/api/v1/recordings/damaged.h5/scans?number=1",
    "/api/v1/recordings/damaged.h5/scans?number=20",
)


@pytest.mark.slow
@FEW_OR_MANY
def test_recording_that_is_damaged_is_listed_as_unreadable_or_answers_what_was_written(
    recording: tuple[bytes, range], tmp_path: Path, count: int
):
    whole, part = recording
    settings = Settings(data_dir=tmp_path)
    folder = settings.folders.recordings
    with TestClient(create_app(settings, FakePipeline())) as client:
        folder.mkdir(exist_ok=True)
        for name in ("damaged.h5", "sound.h5"):
            (folder / name).write_bytes(whole)
        expected = {path: client.get(path).json() for path in UNCHANGED}
        detail = _contents(client.get("/api/v1/recordings/sound.h5").json())
        assert [one["calibration_id"] for one in detail["calibrations"]] == ["sim-0", "sim-1"]
        assert [one["bad_pixels"] for one in detail["calibrations"]] == [1, 2]
        assert [one["from_frame"] for one in detail["calibrations"]] == [0, 16]
        refused = 0
        for number, data in enumerate(damages(whole, count, overwritten=64, part=part)):
            path = folder / "damaged.h5"
            path.write_bytes(data)
            os.utime(path, ns=(number, number))  # what was read of a file is kept by its time
            listed = client.get("/api/v1/recordings")
            assert listed.status_code == 200, data
            documents = {one["id"]: one for one in listed.json()["items"]}
            assert documents["sound.h5"]["state"] == "complete"
            found = client.get("/api/v1/recordings/damaged.h5")
            assert found.status_code == 200, data
            assert documents["damaged.h5"].items() <= found.json().items(), data
            if found.json()["state"] == "unreadable":
                assert found.json()["reason"].startswith("damaged.h5 "), data
                refused += 1
            else:
                assert _contents(found.json()) == detail, data
            for address, answer in expected.items():
                response = client.get(address)
                assert response.status_code in (200, 409, 422), (response.text, data)
                assert response.status_code != 200 or response.json() == answer, data
        assert count / 4 < refused < count


@pytest.mark.parametrize(
    ("written", "flipped"), [(b'"sim-1"', b'"rim-1"'), (b'"pixel": 7', b'"pixel": 5')]
)
def test_recording_with_a_flipped_bit_in_its_calibration_is_listed_as_unreadable(
    recording: tuple[bytes, range], tmp_path: Path, written: bytes, flipped: bytes
):
    settings = Settings(data_dir=tmp_path)
    folder = settings.folders.recordings
    folder.mkdir(exist_ok=True)
    assert written in recording[0]
    (folder / "damaged.h5").write_bytes(recording[0].replace(written, flipped))
    with TestClient(create_app(settings, FakePipeline())) as client:
        (listed,) = client.get("/api/v1/recordings").json()["items"]
        found = client.get("/api/v1/recordings/damaged.h5").json()
    assert (listed["state"], found["state"]) == ("unreadable", "unreadable")
    assert "has damaged data in active_calibrations (the checksum of row" in found["reason"]


def _contents(document: dict[str, Any]) -> dict[str, Any]:
    """What a recording's document says of what is in it.

    One whose last mark is damaged is incomplete: not closed by its writer, for all that is known.
    """
    assert document["state"] in ("complete", "incomplete")
    file = ("id", "state", "size_bytes", "updated_at")
    return {name: value for name, value in document.items() if name not in file}


@pytest.mark.slow
@pytest.mark.parametrize("content", [
    b"[]", b"7", b"{", b"[" * 100_000, b'{"bad_pixels": 3}', b'{"bad_pixels": [[]]}',
    b'{"bad_pixels": {}}', b'{"radiometric": 3}', b'{"radiometric": []}', b'{"id": ["a"]}',
    b'{"radiometric": {"content": 1, "content_hash": 2}}', b'{"table": {}}', b"\xff\xfe\x00",
])  # fmt: skip
def test_recording_with_a_calibration_of_another_make_is_listed_as_unreadable(
    content: bytes, tmp_path: Path
):
    settings = Settings(data_dir=tmp_path)
    settings.folders.recordings.mkdir(exist_ok=True)
    with RecordingWriter(settings.folders.recordings / "made.h5", described()) as writer:
        writer.put_active_calibration(content)
    with TestClient(create_app(settings, FakePipeline())) as client:
        for path in ("/api/v1/recordings/made.h5", "/api/v1/recordings"):
            response = client.get(path)
            assert response.status_code == 200
            found = response.json().get("items", [response.json()])[0]
            assert (found["state"], found["frames_written"]) == ("unreadable", None)
            assert found["reason"].startswith("made.h5 holds ")


@FEW_OR_MANY
def test_table_file_that_is_damaged_is_refused_or_the_same(count: int):
    whole = write_table(content_of_table("0" * 64))
    expected = read_table(whole)
    refused = 0
    for data in damages(whole, count):
        try:
            found = read_table(data)
        except LumilineError:
            refused += 1
            continue
        # What is read is hashed whole; the other bytes are HDF5's own.
        assert found.header() == expected.header()
        for name in ("coefficients_px", "variance_px2", "valid"):
            np.testing.assert_array_equal(getattr(found.table, name), getattr(expected.table, name))
    assert refused > count / 2


def test_table_file_has_nothing_of_variable_length():
    """Where a bit of a length is flipped, HDF5 does not return from reading such a text."""
    assert b"GCOL" not in write_table(content_of_table("0" * 64))


@pytest.fixture(scope="module")
def backup(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("backup")
    database = Database(f"sqlite:///{folder / 'filled.sqlite3'}")
    migrate(database)
    with database.write() as session:
        seed(session)
    back_up(database, folder / "backup")
    database.close()
    return (folder / "backup").read_bytes()


@FEW_OR_MANY
def test_backup_that_is_damaged_is_refused(backup: bytes, tmp_path: Path, count: int):
    file, target = tmp_path / "damaged", Database(f"sqlite:///{tmp_path / 'target.sqlite3'}")
    for data in damages(backup, count):
        file.write_bytes(data)
        with pytest.raises(BackupUnusable) as caught:
            restore(target, file, None)
        assert caught.value.detail.startswith(f"{file} is ")
    assert not (tmp_path / "target.sqlite3").exists()
    target.close()


PROFILE = "bar"


@pytest.mark.slow
def test_profile_that_is_damaged_leaves_the_list_whole(tmp_path: Path):
    settings = Settings(data_dir=tmp_path)
    folder = settings.folders.profiles
    whole = profile_text(PROFILE, folder).replace(f'"{PROFILE}"', '"own"', 1).encode()
    with TestClient(create_app(settings, FakePipeline())) as client:
        names = {one["id"] for one in client.get("/api/v1/device-profiles").json()["items"]}
        folder.mkdir(exist_ok=True)
        (folder / "sound.toml").write_bytes(whole.replace(b'"own"', b'"sound"', 1))
        for number, data in enumerate(damages(whole, MANY)):
            (folder / "own.toml").write_bytes(data)
            one = client.get("/api/v1/device-profiles/own")
            listed = client.get("/api/v1/device-profiles")
            assert one.status_code in (200, 422), data
            assert listed.status_code == 200, data
            found = {item["id"] for item in listed.json()["items"]}
            assert found >= names | {"sound"}
            assert ("own" in found) == (one.status_code == 200)
            if number % PLANNED == PLANNED - 1:  # what is read as a profile can be planned with
                plan = client.get("/api/v1/device-profiles/own/plan")
                assert plan.status_code in (200, 422), data


TOOLS = {
    "items": [
        {
            "id": f"probe-{number}",
            "device_id": "sim",
            "title": "Probe \u00e4",
            "markers_mm": [
                *([0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 60.0, 0.0]),
                [20.0, 15.0, 40.0 + 30.0 * number],
            ],
            "tip_mm": [-150.0, 0.5, 1e-3],
            "note": "",
        }
        for number in range(2)
    ]
}


@pytest.mark.slow
@FEW_OR_MANY
def test_tool_file_that_is_damaged_is_refused_or_holds_tools(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
):
    """The command says what is wrong in a line, or sends what the file has; never a traceback."""
    file, whole = tmp_path / "tools.json", json.dumps(TOOLS, ensure_ascii=False).encode()
    settings = Settings(data_dir=tmp_path / "data")
    with TestClient(create_app(settings, FakePipeline())) as server:
        monkeypatch.setattr(tool_files, "client_session", partial(_session, server))
        for data in damages(whole, count):
            file.write_bytes(data)
            result = CliRunner().invoke(app, ["tools", "create", str(file)])
            assert isinstance(result.exception, SystemExit | None), (data, result.exception)
            assert result.exit_code in (0, 1, 2), data
            expected = "made: " if result.exit_code == 0 else "error: "
            assert expected in result.output, data
            listed = server.get("/api/v1/tools")
            assert listed.status_code == 200
            for tool in listed.json()["items"]:
                assert server.delete(f"/api/v1/tools/{tool['id']}").status_code == 204


@FEW_OR_MANY
def test_tool_file_for_offline_commands_that_is_damaged_is_refused_or_holds_tools(
    tmp_path: Path, count: int
):
    """`export --tools`; what the file still holds is checked as what a person wrote."""
    file, whole = tmp_path / "tools.json", json.dumps(TOOLS, ensure_ascii=False).encode()
    details = []
    for data in damages(whole, count):
        file.write_bytes(data)
        try:
            tools = read_tools(file)
        except LumilineError as error:
            details.append(error.detail)
            continue
        assert all(np.isfinite(tool.markers_mm).all() and len(tool) >= 3 for tool in tools), data
    assert len(details) > count / 3
    assert all(str(file) in one or "tool" in one for one in details)


@FEW_OR_MANY
def test_calibration_file_that_is_damaged_is_refused_or_a_calibration(tmp_path: Path, count: int):
    """It has no checksum: a digit that is another one is another calibration, with another hash."""
    file, whole = tmp_path / "camera.json", DOCUMENT.dump_json(nominal_calibration())
    file.write_bytes(whole)
    expected = read_calibration(file)
    details = []
    for data in damages(whole, count):
        file.write_bytes(data)
        try:
            found = read_calibration(file)
        except LumilineError as error:
            details.append(error.detail)
            continue
        same = found.calibration == expected.calibration
        assert same == (found.content_hash == expected.content_hash), data
        assert all(model.pixels > 0 for model in found.calibration.models), data
    assert len(details) > count / 3
    assert all(str(file) in one for one in details)


@FEW_OR_MANY
@pytest.mark.parametrize("kind", ["npy", "csv", "h5"])
def test_scan_file_that_is_damaged_is_refused_or_holds_counts(
    recording: tuple[bytes, range], tmp_path: Path, kind: str, count: int
):
    """An array and a CSV have no checksum: a digit that is another one is another count."""
    file, counts = tmp_path / f"scans.{kind}", np.arange(200, 330, dtype=np.uint16).reshape(2, -1)
    if kind == "npy":
        np.save(file, counts)
    elif kind == "csv":
        np.savetxt(file, counts, fmt="%d", delimiter=",")
    else:
        file.write_bytes(recording[0])
    expected, details = read_scans(file).scans, []
    for data in damages(file.read_bytes(), count, part=range(128)):
        file.write_bytes(data)
        try:
            found = read_scans(file).scans
        except LumilineError as error:
            details.append(error.detail)
            continue
        assert found.dtype == np.uint16, data
        assert kind != "h5" or np.array_equal(found, expected), data
    assert len(details) > count / 4
    assert all(file.name in one for one in details)


@pytest.mark.parametrize("header", [
    "{'descr': '<u2', 'fortran_order': False, 'shape': (2, 65",
    "{'descr': '<u2', 'fortran_order': False, 'shape': (99999999, 65000)}",
    "{'descr': '<u2', 'fortran_order': False, 'shape': (2, 99999999999999999999)}",
    "{'descr': '|O', 'fortran_order': False, 'shape': (2, 65)}",
    "-" * 8000 + "1",
    "(" * 8000,
])  # fmt: skip
def test_peaks_of_an_array_with_a_damaged_header_says_that_it_cannot_be_read(
    tmp_path: Path, header: str
):
    file, text = tmp_path / "scans.npy", header.encode() + b"\n"
    size = len(text).to_bytes(2, "little")
    file.write_bytes(b"\x93NUMPY\x01\x00" + size + text + bytes(2 * 2 * 65))
    result = CliRunner().invoke(app, ["peaks", str(file)], env={"COLUMNS": "500"})
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == 2
    assert f"error: {file} cannot be read as a NumPy array: " in result.output


@contextmanager
def _session(server: TestClient, *_: Any) -> Iterator[Any]:
    """A client that sends to the server in this process, and reports as the command's own does."""
    try:
        yield _Requests(server)
    except ServerError as error:
        raise fail(str(error)) from error


class _Requests:
    def __init__(self, server: TestClient) -> None:
        self._server = server

    def request(self, method: str, path: str, body: Any) -> Any:
        answer = self._server.request(method, path, json=body)
        assert answer.status_code < 500, answer.text
        if answer.status_code >= 400:
            raise ServerError(answer.text)
        return answer.json()


class ServerError(Exception):
    """What the server refused."""
