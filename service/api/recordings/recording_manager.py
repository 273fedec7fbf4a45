"""RecordingManager: starts and stops recordings of running devices, and knows the stored ones."""

import logging
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Annotated, Final

from compute.errors import InvalidParameter
from service.api.inputs import of_application
from service.api.paging import Page, Paging, page_of_sequence
from service.api.recordings.recorder import Recorder, WriteCounters, writer_job
from service.api.recordings.repository import RecordingRepository, unread
from service.api.recordings.schema import NewRecording, RecordingDetail, RecordingDocument
from service.database.stored_files import StoredFile, StoredFiles
from service.pipeline.interface import Pipeline, RunningDevice
from service.problems.errors import (
    InsufficientStorage,
    RecordingExists,
    RecordingInProgress,
    RecordingInUse,
    UnknownRecording,
)

_log = logging.getLogger(__name__)

_LOOK_S: Final = 0.2
_CLOSE_S: Final = 30.0
"""How long a request to stop waits for the file to be closed."""
_SHUTDOWN_S: Final = 10.0
"""How long the server's end waits for all files: well below what graceful.STOP_WITHIN_S gives."""
_SHUT_DOWN: Final = "the server was shut down"


class RecordingManager:
    """Recordings of this server; all methods may be called from any thread.

    Args:
        live: the running devices.
        folder: where recordings lie.
        free_bytes: what they leave free on the disk.
        flush_s: how often they are flushed [s].
        stored: recordings of other gateways on the same database; None: there are none.
    """

    def __init__(
        self,
        live: Pipeline,
        folder: Path,
        free_bytes: int = 0,
        flush_s: float = 1.0,
        stored: StoredFiles | None = None,
    ) -> None:
        self.library = RecordingRepository(folder)
        self._stored = stored
        self._live = live
        self.free_bytes = free_bytes
        self._flush_s = flush_s
        self._starting: dict[str, str] = {}
        """Device by name of what is begun, outside the lock: a process takes its time to start."""
        self._active: dict[str, Recorder] = {}
        self._failed: dict[str, str] = {}
        self._past: dict[str, WriteCounters] = {}
        self._lock = Lock()
        self._closing = Event()
        self._watcher = Thread(target=self._watch, name="recordings", daemon=True)
        self._watcher.start()

    def start(self, device_id: str, request: NewRecording) -> RecordingDetail:
        """Begin to record a running device.

        Raises:
            DeviceNotRunning: it does not run.
            RecordingExists: there is a file of the name.
            RecordingInProgress: the device has a recording already.
            InsufficientStorage: there is too little free space, or none can be written to.
            InvalidParameter: scans are asked for, and the device has none.
        """
        session = self._live.session(device_id)
        if session.description.readout == "bar-peaks" and "lines" in request.contents:
            raise InvalidParameter(
                f'device "{device_id}" is fused, and has no scans to record; ask for contents '
                '["results"], and record the scans of its bars',
                device_id=device_id,
            )
        begin = datetime.now(UTC)
        name = request.id or f"{device_id}-{begin:%Y%m%dT%H%M%S-%f}.h5"
        folder = self.library.folder
        free = shutil.disk_usage(folder).free
        if free < self.free_bytes:
            raise InsufficientStorage(
                f"{free} bytes are free on the disk of the recordings; {self.free_bytes} have to "
                "stay free: delete recordings",
                free_bytes=free,
            )
        job = writer_job(session, request, folder / name, begin, self.free_bytes, self._flush_s)
        self._reserve(name, device_id)
        try:
            if job.path.exists():
                raise _exists(name)
            self._list_begun(name, device_id, begin)
            try:
                recorder = Recorder(job, session)
            except OSError as error:
                if job.path.exists():
                    raise _exists(name) from error
                raise InsufficientStorage(f"the recording cannot be written: {error}") from error
            with self._lock:
                self._failed.pop(name, None)
                self._active[name] = recorder
        except Exception:
            if self._stored is not None and not job.path.exists():
                self._stored.discard(name)
            raise
        finally:
            with self._lock:
                del self._starting[name]
        session.attach(recorder)
        _log.info("recording %s of device %s has begun", name, device_id)
        if self._closing.is_set():
            recorder.stop(_SHUT_DOWN)
        return self.get(name)

    def _list_begun(self, name: str, device_id: str, begin: datetime) -> None:
        """Let other gateways know the recording; raises RecordingExists where one has its name."""
        if self._stored is None:
            return
        document = _begun(name, device_id, begin).model_dump(mode="json")
        taken = self._stored.begin(name, document, time.time_ns())
        if taken is not None:
            raise RecordingExists(
                f'gateway "{taken.gateway}" has a recording "{name}"; choose another name',
                recording_id=name,
                gateway=taken.gateway,
            )

    def announce_files(self) -> None:
        """List the recordings of this server for other gateways."""
        if self._stored is None:
            return
        found = {}
        for name, changed_ns in self.library.files():
            with suppress(UnknownRecording, OSError):  # gone meanwhile
                document = self.library.detail(self._document(name))
                found[name] = changed_ns, document.model_dump(mode="json")
        self._stored.publish(found, self._written_now)

    def _written_now(self) -> frozenset[str]:
        with self._lock:
            return frozenset(
                name for name, one in self._active.items() if one.status.ended is None
            ) | frozenset(self._starting)

    def _other(self, name: str) -> StoredFile | None:
        return None if self._stored is None else self._stored.other(name)

    def path(self, name: str) -> Path:
        """Return the path of a recording of this server.

        Raises:
            UnknownRecording.
            FileElsewhere: another gateway has it.
        """
        try:
            return self.library.path(name)
        except UnknownRecording:
            other = self._other(name)
            if other is None:
                raise
            raise other.elsewhere("recording") from None

    def _reserve(self, name: str, device_id: str) -> None:
        """Let no other recording of the name, or of the device, begin meanwhile."""
        with self._lock:
            busy = {
                recorder.session.device_id: other
                for other, recorder in self._active.items()
                if recorder.status.ended is None
            } | {device: other for other, device in self._starting.items()}
            if device_id in busy:
                raise RecordingInProgress(
                    f'device "{device_id}" is being recorded to "{busy[device_id]}"; stop that '
                    "first",
                    recording_id=busy[device_id],
                )
            if name in busy.values():
                raise _exists(name)
            self._starting[name] = device_id

    def stop(self, name: str) -> RecordingDetail:
        """End a recording and close its file; of one that has ended nothing changes.

        Raises:
            UnknownRecording: there is none of the name.
            FileElsewhere: another gateway writes it.
        """
        with self._lock:
            recorder = self._active.get(name)
        other = None if recorder is not None else self._other(name)
        if other is not None and other.document["state"] == "recording":
            raise other.elsewhere("recording")
        if recorder is not None:
            recorder.session.detach(recorder)
            recorder.stop("stopped by request")
            recorder.wait(_CLOSE_S)
            self._settle()
        return self.get(name)

    def get(self, name: str) -> RecordingDetail:
        """Return a recording, of another gateway as that listed it; raises UnknownRecording."""
        other = self._other(name)
        if other is not None and (other.here or not self._is_here(name)):
            return RecordingDetail.model_validate(other.document | {"gateway": other.gateway})
        return self.library.detail(self._document(name))

    def _is_here(self, name: str) -> bool:
        try:
            self.library.path(name)
        except UnknownRecording:
            return False
        return True

    def open_recording(self, device_id: str) -> str | None:
        """Return the recording of a device that is being written, None without one."""
        with self._lock:
            for name, recorder in self._active.items():
                if recorder.session.device_id == device_id and recorder.status.ended is None:
                    return name
        return None

    def page(self, device_id: str | None, paging: Paging) -> Page[RecordingDocument]:
        """Return a page of recordings, those that were changed last first."""
        others = {} if self._stored is None else self._stored.others()
        files = dict(self.library.files())
        # What another gateway writes into a shared directory is as that says.
        others = {name: one for name, one in others.items() if one.here or name not in files}
        files |= {name: one.changed_ns for name, one in others.items()}

        def listed(file: tuple[str, int]) -> RecordingDocument | None:
            other = others.get(file[0])
            return self.listed(file[0]) if other is None else _of_other(other)

        found = list(files.items())
        if device_id is not None:
            found = [
                file
                for file in found
                if (document := listed(file)) is not None and document.device_id == device_id
            ]
        return page_of_sequence(found, paging, listed, lambda file: (-file[1], file[0]))

    def finished_path(self, name: str) -> Path:
        """Return the path of a recording that is not being written.

        Raises:
            UnknownRecording, RecordingInProgress.
            FileElsewhere: another gateway has it.
        """
        path = self.path(name)
        with self._lock:
            recorder, starting = self._active.get(name), name in self._starting
        other = None if recorder is not None else self._other(name)
        if other is not None and other.here and other.document["state"] == "recording":
            raise RecordingInProgress(
                f'recording "{name}" is being written by gateway "{other.gateway}"; stop it there '
                "first",
                recording_id=name,
            )
        if starting or (recorder is not None and recorder.status.ended is None):
            raise RecordingInProgress(
                f'recording "{name}" is being written; stop it first', recording_id=name
            )
        return path

    def delete(self, name: str, referrers_of: Callable[[str], dict[str, list[str]]]) -> None:
        """Delete a recording's file.

        Args:
            name: of the recording.
            referrers_of: returns the ids of what refers to it, by kind.

        Raises:
            UnknownRecording, RecordingInProgress.
            RecordingInUse: a device replays it, or an open run reads it.
        """
        path = self.finished_path(name)
        referrers = referrers_of(name)
        if referrers:
            raise RecordingInUse(_in_use(name, referrers), recording_id=name, referrers=referrers)
        path.unlink(missing_ok=True)
        with self._lock:
            self._failed.pop(name, None)

    def written(self) -> dict[str, WriteCounters]:
        """Return the recording counters of each device since the server's start."""
        with self._lock:
            found = dict(self._past)
            for recorder in self._active.values():
                device = recorder.session.device_id
                found[device] = found.get(device, WriteCounters()).with_recorder(recorder)
        return found

    def close(self) -> None:
        """Close the files of all recordings; there are no others from now on.

        A writer that takes longer than _SHUTDOWN_S is left to close its file by itself.
        """
        self._closing.set()
        self._watcher.join()
        with self._lock:
            active = dict(self._active)
        for recorder in active.values():
            recorder.session.detach(recorder)
            recorder.stop(_SHUT_DOWN)
        end = time.monotonic() + _SHUTDOWN_S
        for name, recorder in active.items():
            if not recorder.wait(max(0.0, end - time.monotonic())):
                _log.error(
                    "recording %s: its file was not closed within %g s; its process goes on with "
                    "it by itself",
                    name,
                    _SHUTDOWN_S,
                )
        if self._stored is not None:
            self._settle()

    def _watch(self) -> None:
        """End recordings whose device has ended, and forget those that have."""
        while not self._closing.wait(_LOOK_S):
            try:
                with self._lock:
                    active = list(self._active.values())
                for recorder in active:
                    if recorder.status.ended is None and recorder.session.drained:
                        recorder.stop(_why(recorder.session))
                self._settle()
            except Exception:  # noqa: BLE001 - the others' recordings go on
                _log.exception("recordings are not looked after")

    def _settle(self) -> None:
        """Detach and forget recordings that have ended."""
        ended = []
        with self._lock:
            for name, recorder in list(self._active.items()):
                if recorder.status.ended is None:
                    continue
                recorder.session.detach(recorder)
                level = logging.ERROR if recorder.status.failed else logging.INFO
                _log.log(level, "recording %s has ended: %s", name, recorder.status.ended)
                if recorder.status.failed:
                    self._failed[name] = recorder.status.ended
                del self._active[name]
                ended.append(name)
                device = recorder.session.device_id
                self._past[device] = self._past.get(device, WriteCounters()).with_recorder(recorder)
        if self._stored is None:
            return
        for name in ended:
            with suppress(UnknownRecording, OSError):
                changed_ns = self.library.path(name).stat().st_mtime_ns
                document = self.library.detail(self._document(name)).model_dump(mode="json")
                self._stored.end(name, document, changed_ns)

    def listed(self, name: str) -> RecordingDocument | None:
        """Return the document of a recording of a list; None: it was deleted meanwhile."""
        try:
            return self._document(name)
        except (UnknownRecording, OSError):
            return None

    def _document(self, name: str) -> RecordingDocument:
        with self._lock:
            recorder, failure = self._active.get(name), self._failed.get(name)
            starting = name in self._starting
        if recorder is not None and recorder.status.ended is None:
            return _of_recorder(name, recorder)
        document = self.library.document(name)
        if starting:
            return document.model_copy(update={"state": "recording"})
        if failure is not None and document.state != "complete":
            return document.model_copy(update={"state": "failed", "reason": failure})
        return document


def _begun(name: str, device_id: str, begin: datetime) -> RecordingDetail:
    """Return a recording of which nothing is written yet."""
    members = unread("recording", None) | {"device_id": device_id, "started_at": begin}
    return RecordingDetail(**members, id=name, size_bytes=0, updated_at=begin, calibrations=[])


def _of_other(other: StoredFile) -> RecordingDocument:
    members = other.document | {"gateway": other.gateway}
    del members["calibrations"]
    return RecordingDocument.model_validate(members)


def _of_recorder(name: str, recorder: Recorder) -> RecordingDocument:
    """Return how a recording stands that is being written."""
    job, state = recorder.job, recorder.status.state
    return RecordingDocument(
        **unread("recording", None)
        | {
            "id": name,
            "device_id": job.description.name,
            "contents": [
                *(["lines"] if job.lines else []),
                *(["results"] if job.results else []),
            ],
            "frames_written": state.frames,
            "frames_missing": state.missing,
            "frames_dropped_compute": state.dropped_compute,
            "frames_dropped_writer": recorder.dropped_frames,
            "frames_refused": state.refused,
            "size_bytes": recorder.status.size_bytes,
            "started_at": datetime.fromisoformat(job.provenance["started_at"]),
            "updated_at": datetime.now(UTC),
        }
    )


def _why(session: RunningDevice) -> str:
    status = session.status()
    if status.state == "stopped":
        return "the device was stopped"
    if status.state == "running" or (status.state == "starting" and status.reason is None):
        return "the device was started again"  # the status is that of the new start
    return f"the device has {status.state}: {status.reason or 'no reason given'}"


def _in_use(name: str, referrers: dict[str, list[str]]) -> str:
    if "devices" in referrers:
        return (
            f'recording "{name}" is the source of device "{referrers["devices"][0]}"; give that '
            "another source, or delete it, first"
        )
    return (
        f'recording "{name}" is read by run "{referrers["runs"][0]}"; wait for its end, or cancel '
        "it, first"
    )


def _exists(name: str) -> RecordingExists:
    return RecordingExists(
        f'recording "{name}" exists already and is never overwritten; choose another name',
        recording_id=name,
    )


RecordingsDep = Annotated[RecordingManager, of_application("recordings")]
