"""RecordingRetention: deletes old recordings by age and total size, where settings say so."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from threading import Event, Lock, Thread
from typing import Annotated, Final

from compute.errors import LumilineError
from service.api.inputs import of_application
from service.api.recordings.recording_manager import RecordingManager
from service.api.recordings.repository import recording_referrers
from service.api.recordings.schema import RecordingDocument, RetentionDocument
from service.database.audited_session import entry
from service.database.engine import Database
from service.principal import SERVICE, Act, current_act
from service.problems.errors import RecordingInProgress, RecordingInUse, UnknownRecording

_log = logging.getLogger(__name__)

INTERVAL_S: Final = 600.0
RECENT: Final = timedelta(hours=1)
"""A recording that was changed within it is not deleted for its size: somebody works with it."""


@dataclass(frozen=True)
class RetentionLimits:
    """Limits of age and size of kept recordings; None: without limit.

    Args:
        max_age: since a file was last changed.
        max_total_bytes: of all recordings together; the oldest are deleted first.
    """

    max_age: timedelta | None = None
    max_total_bytes: int | None = None

    def __bool__(self) -> bool:
        """Whether there is any limit."""
        return self.max_age is not None or self.max_total_bytes is not None


@dataclass(frozen=True)
class RetentionState:
    """Deletions since the server's start, and the result of the last check.

    Args:
        checked_at: when the last one was; None: none yet.
        total_bytes: of all recordings after it.
        held: ids that are over a limit and kept, as something refers to them or they are
            unreadable.
        deleted: recordings since the start.
        deleted_bytes: their size.
    """

    checked_at: datetime | None = None
    total_bytes: int = 0
    held: tuple[str, ...] = ()
    deleted: int = 0
    deleted_bytes: int = 0


def _utc_now() -> datetime:
    return datetime.now(UTC)


@dataclass
class _Check:
    total_bytes: int
    held: list[str] = field(default_factory=list)
    deleted: int = 0
    deleted_bytes: int = 0


class RecordingRetention:
    """Checks all recordings now and then, in a thread of its own; without limits it does nothing.

    Args:
        recordings: of the server.
        database: tells what refers to a recording, and has the audit log.
        limits: of the settings.
        now: the time.
        is_mine: whether this server tidies the folder, which several may share.
    """

    def __init__(
        self,
        recordings: RecordingManager,
        database: Database,
        limits: RetentionLimits,
        now: Callable[[], datetime] = _utc_now,
        is_mine: Callable[[], bool] = lambda: True,
    ) -> None:
        self.limits = limits
        self._is_mine = is_mine
        self._woken = Event()
        self._recordings = recordings
        self._database = database
        self._now = now
        self._state = RetentionState()
        self._lock = Lock()
        self._checking = Lock()
        self._ended = Event()
        self._thread = Thread(target=self._run, name="retention", daemon=True)

    @property
    def state(self) -> RetentionState:
        """Deletions so far, and the last check."""
        with self._lock:
            return self._state

    def document(self) -> RetentionDocument:
        """Return limits and state as clients see them."""
        limits, state = self.limits, self.state
        return RetentionDocument(
            max_age_s=None if limits.max_age is None else limits.max_age.total_seconds(),
            max_total_bytes=limits.max_total_bytes,
            checked_at=state.checked_at,
            total_bytes=state.total_bytes,
            held_recording_ids=list(state.held),
            deleted_recordings=state.deleted,
            deleted_bytes=state.deleted_bytes,
        )

    def start(self) -> None:
        """Start the thread, if there is a limit."""
        if self.limits:
            self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._woken.set()
        if self._thread.is_alive():
            self._thread.join(10.0)

    def wake(self) -> None:
        """Check now: the folder has just become this server's to tidy."""
        self._woken.set()

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                if self._is_mine():
                    self.check()
            except Exception:  # noqa: BLE001 - the next check may work
                _log.exception("old recordings are not looked for now")
            self._woken.wait(INTERVAL_S)
            self._woken.clear()

    def check(self) -> None:
        """Delete recordings over a limit that nothing uses; one check at a time."""
        with self._checking:
            self._check()

    def _check(self) -> None:
        now = self._now()
        documents = list(self._oldest_first())
        check = _Check(sum(one.size_bytes for one in documents))
        for document in documents:
            if self._ended.is_set():
                break
            why = self._reason(document, now, check.total_bytes)
            if why is None:
                continue
            if document.state != "unreadable" and self._delete(document, why):
                check.deleted += 1
                check.deleted_bytes += document.size_bytes
                check.total_bytes -= document.size_bytes
            else:
                check.held.append(document.id)
        with self._lock:
            self._state = RetentionState(
                now,
                check.total_bytes,
                tuple(check.held),
                self._state.deleted + check.deleted,
                self._state.deleted_bytes + check.deleted_bytes,
            )

    def _oldest_first(self) -> Iterator[RecordingDocument]:
        for name, _ in sorted(self._recordings.library.files(), key=lambda file: file[1]):
            document = self._recordings.listed(name)
            if document is not None:
                yield document

    def _reason(self, document: RecordingDocument, now: datetime, total_bytes: int) -> str | None:
        """Return why a recording is to be deleted; None: it is within the limits."""
        if document.state == "recording":
            return None
        age = now - document.updated_at
        if self.limits.max_age is not None and age > self.limits.max_age:
            return f"older than {self.limits.max_age}"
        limit = self.limits.max_total_bytes
        if limit is not None and total_bytes > limit and age > RECENT:
            return f"recordings have {total_bytes} bytes, more than {limit}"
        return None

    def _delete(self, document: RecordingDocument, why: str) -> bool:
        """Delete a recording with an entry in the audit log; False: it is held, or it failed."""
        token = current_act.set(Act(SERVICE, "recording-retention"))
        try:
            # The entry first: what cannot be written down is not deleted.
            with self._database.write() as session:
                before = {
                    "size_bytes": document.size_bytes,
                    "updated_at": document.updated_at.isoformat(),
                    "reason": why,
                }
                session.add(entry("recording", document.id, "done", before=before))
                session.flush()
                self._recordings.delete(document.id, partial(recording_referrers, self._database))
        except (RecordingInUse, RecordingInProgress, UnknownRecording):
            return False
        except (LumilineError, OSError) as error:
            detail = error.detail if isinstance(error, LumilineError) else str(error)
            _log.warning("recording %s could not be deleted: %s", document.id, detail)
            return False
        finally:
            current_act.reset(token)
        _log.info("recording %s was deleted: %s", document.id, why)
        return True


RetentionDep = Annotated[RecordingRetention, of_application("retention")]
