"""RecordingRepository: the folder of recordings, described from the files themselves."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy import select

from compute.errors import InvalidRecording
from service.api.devices.driver_factory import recording_path
from service.api.devices.schema import RECORDING_PATTERN
from service.api.recordings.active_calibration_file import read_names
from service.api.recordings.schema import (
    Content,
    RecordingDetail,
    RecordingDocument,
    State,
    UsedCalibration,
)
from service.database.engine import Database
from service.database.models import DeviceRow, RunRow
from service.jobs.store import OPEN

if TYPE_CHECKING:
    from hardware.recording.layout import RecordingInfo
    from hardware.recording.reader import RecordingReader


@dataclass(frozen=True)
class _CachedDocument:
    """Description read from a file, with the state of the file that it is of."""

    inode: int
    size: int
    modified_ns: int
    document: RecordingDocument
    calibrations: list[UsedCalibration]


class RecordingRepository:
    """Recordings below a folder, whoever put them there; what was read of a file is kept.

    Args:
        folder: the data directory's folder ``recordings``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._kept: dict[str, _CachedDocument] = {}
        self._lock = Lock()

    def files(self) -> list[tuple[str, int]]:
        """Return the names of all recordings, and when their files were changed [ns]."""
        found = list(self._files())
        there = {name for name, _ in found}
        with self._lock:
            self._kept = {name: kept for name, kept in self._kept.items() if name in there}
        return found

    def path(self, name: str) -> Path:
        """Return a recording's path; raises UnknownRecording."""
        return recording_path(name, self.folder)

    def document(self, name: str) -> RecordingDocument:
        """Return a recording's document from its file; for an unreadable one, the reason.

        Raises:
            UnknownRecording: there is no such file.
        """
        return self._read(name).document

    def detail(self, document: RecordingDocument) -> RecordingDetail:
        """Return it with the calibrations in the file; none where it cannot be read."""
        calibrations = self._read(document.id).calibrations
        return RecordingDetail(**dict(document), calibrations=calibrations)

    def _read(self, name: str) -> _CachedDocument:
        path = self.path(name)
        status = path.stat()
        with self._lock:
            kept = self._kept.get(name)
        now = (status.st_ino, status.st_size, status.st_mtime_ns)
        if kept is not None and (kept.inode, kept.size, kept.modified_ns) == now:
            return kept
        common = {
            "id": name,
            "size_bytes": status.st_size,
            "updated_at": datetime.fromtimestamp(status.st_mtime, UTC),
        }
        calibrations: list[UsedCalibration] = []
        try:
            with _reader(path) as reader:
                found = RecordingDocument(**common, **_members(reader.info))
                calibrations = _used_calibrations(reader, path.name)
        except InvalidRecording as error:
            found = RecordingDocument(**common, **unread("unreadable", error.detail))
        cached = _CachedDocument(*now, found, calibrations)
        with self._lock:
            self._kept[name] = cached
        return cached

    def _files(self) -> Iterator[tuple[str, int]]:
        """Yield names that a client can ask for, and when the files were changed [ns]."""
        folder = self.folder.resolve()
        for path in folder.rglob("*.h5"):
            name = path.relative_to(folder).as_posix()
            if re.fullmatch(RECORDING_PATTERN, name) is None or len(name) > 200:
                continue
            try:
                if path.resolve().is_relative_to(folder) and path.is_file():
                    yield name, path.stat().st_mtime_ns
            except OSError:
                continue  # gone meanwhile


def unread(state: State, reason: str | None) -> dict[str, Any]:
    """Return the members of a document that nothing is known of."""
    members = (
        "device_id", "frames_written", "duration_s", "frames_missing", "frames_dropped_compute",
        "frames_dropped_writer", "frames_refused", "started_at",
    )  # fmt: skip
    return dict.fromkeys(members) | {"state": state, "reason": reason, "contents": []}


def _reader(path: Path) -> "RecordingReader":
    # The file library is loaded by who reads a recording.
    from hardware.recording.reader import RecordingReader

    return RecordingReader(path, columns=False)


def _members(info: "RecordingInfo") -> dict[str, Any]:
    contents: list[Content] = []
    if info.lines:
        contents.append("lines")
    if info.results:
        contents.append("results")
    return {
        "device_id": info.description.name,
        "state": "complete" if info.complete else "incomplete",
        "reason": info.state.reason or None,
        "contents": contents,
        "frames_written": info.frames,
        "duration_s": info.duration_s,
        "frames_missing": info.lost,
        "frames_dropped_compute": info.state.dropped_compute,
        "frames_dropped_writer": info.state.dropped_writer,
        "frames_refused": info.state.refused,
        "started_at": _moment(info.provenance.get("started_at")),
    }


def _moment(text: object) -> datetime | None:
    try:
        found = datetime.fromisoformat(str(text))
    except ValueError:
        return None
    return found if found.tzinfo is not None else None


def _used_calibrations(reader: "RecordingReader", where: str) -> list[UsedCalibration]:
    """Return the calibrations of a file, in the order in which they became active.

    Raises:
        InvalidRecording: one of them, or the first frame of one, is damaged.
    """
    count = reader.info.state.active_calibrations
    if count == 0:
        return []
    rows = reader.column("active_calibration")
    used = []
    for row in range(count):
        names = read_names(reader.active_calibration(row)[0], where)
        first = next(iter(np.flatnonzero(rows == row)[:1].tolist()), None)
        if first is not None:
            # Their checksums confirm that it is this frame, and not the one before.
            reader.block(max(first - 1, 0), first + 1, results=False)
        used.append(UsedCalibration(**vars(names), from_frame=first))
    return used


def recording_referrers(database: Database, name: str) -> dict[str, list[str]]:
    """Return the ids of the devices that replay a recording, and of the open runs that read it."""
    path = PurePosixPath(name)
    with database.read() as session:
        sources = session.execute(select(DeviceRow.id, DeviceRow.source)).all()
        open_runs = select(RunRow.id, RunRow.request).where(RunRow.state.in_(OPEN))
        requests = session.execute(open_runs).all()
    devices = [
        str(device_id)
        for device_id, source in sources
        if source.get("kind") == "replay" and _recording_path(source) == path
    ]
    runs = [str(run_id) for run_id, request in requests if _recording_path(request) == path]
    return {kind: ids for kind, ids in (("devices", devices), ("runs", runs)) if ids}


def _recording_path(document: dict[str, Any]) -> PurePosixPath:
    return PurePosixPath(str(document.get("recording_id")))
