"""RecordingRepository: the folder of recordings, described from the files themselves."""

import json
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
        path = self.path(name)
        status = path.stat()
        with self._lock:
            kept = self._kept.get(name)
        now = (status.st_ino, status.st_size, status.st_mtime_ns)
        if kept is not None and (kept.inode, kept.size, kept.modified_ns) == now:
            return kept.document
        common = {
            "id": name,
            "size_bytes": status.st_size,
            "updated_at": datetime.fromtimestamp(status.st_mtime, UTC),
        }
        try:
            with _reader(path) as reader:
                found = RecordingDocument(**common, **_members(reader.info))
        except InvalidRecording as error:
            found = RecordingDocument(**common, **unread("unreadable", error.detail))
        with self._lock:
            self._kept[name] = _CachedDocument(*now, found)
        return found

    def detail(self, document: RecordingDocument) -> RecordingDetail:
        """Return it with the calibrations in the file; none where it cannot be read."""
        used: list[UsedCalibration] = []
        if document.state != "unreadable":
            try:
                with _reader(self.path(document.id)) as reader:
                    used = _used(reader)
            except InvalidRecording as error:
                document = document.model_copy(update={"reason": error.detail})
        return RecordingDetail(**dict(document), calibrations=used)

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


def _used(reader: "RecordingReader") -> list[UsedCalibration]:
    """Return the calibrations of a file, in the order in which they came into force."""
    if reader.info.state.in_force == 0:
        return []
    rows = reader.column("in_force")
    used = []
    for row in range(reader.info.state.in_force):
        try:
            found = json.loads(reader.in_force(row)[0] or b"{}")
        except ValueError:
            found = {}
        first = np.flatnonzero(rows == row)[:1].tolist()
        texts = {
            name: None if found.get(key) is None else str(found[key])
            for name, key in (
                ("calibration_id", "id"), ("content_hash", "content_hash"), ("table_id", "table"),
            )
        }  # fmt: skip
        pixels = found.get("radiometric")
        radiometric = str(pixels.get("id")) if isinstance(pixels, dict) else None
        used.append(
            UsedCalibration(
                **texts,
                radiometric_id=radiometric,
                bad_pixels=len(found.get("bad_pixels", ())),
                from_frame=first[0] if first else None,
            )
        )
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
