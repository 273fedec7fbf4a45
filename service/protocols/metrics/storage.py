"""DatabaseCollector, RecordingsCollector: metrics of the database, its runs, and recordings."""

import shutil
from collections.abc import Iterator
from typing import get_args

from prometheus_client import Metric
from prometheus_client.registry import Collector
from sqlalchemy import func, select

from service.api.recordings.recording_manager import RecordingManager
from service.database.engine import Database
from service.database.models import RunRow
from service.jobs.run_manager import BOUNDS_S, DurationHistogram
from service.jobs.store import STATES, Kind
from service.problems.errors import NotReady
from service.protocols.metrics.families import counter, gauge, histogram, single


class DatabaseCollector(Collector):
    """Whether the database answers, and the runs in it.

    Args:
        database: the database.
        durations: of the runs of this server.
    """

    def __init__(self, database: Database, durations: DurationHistogram) -> None:
        self._database = database
        self._durations = durations

    def collect(self) -> Iterator[Metric]:
        """Yield what there is; without an answer no counts of runs, but that there was none."""
        found: dict[tuple[str, str], int] | None = None
        try:
            with self._database.read() as session:
                query = select(RunRow.kind, RunRow.state, func.count()).group_by(
                    RunRow.kind, RunRow.state
                )
                found = {(kind, state): count for kind, state, count in session.execute(query)}
        except NotReady:
            pass  # logged there
        yield single("database_up", "1 when the database answers.", float(found is not None))
        if found is not None:
            yield gauge(
                "runs",
                "Runs by kind and state, until they are deleted.",
                (
                    ((kind, state), found.get((kind, state), 0))
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
    """Recordings that are being written, and the disk that they lie on.

    Args:
        recordings: of this server.
    """

    def __init__(self, recordings: RecordingManager) -> None:
        self._recordings = recordings

    def collect(self) -> Iterator[Metric]:
        """Yield what there is."""
        written = self._recordings.written()
        yield gauge(
            "recordings_open",
            "Recordings that are being written.",
            (((name,), had.open) for name, had in written.items()),
        )
        yield counter(
            "recording_written_bytes",
            "Bytes written to recordings.",
            (((name,), had.size_bytes) for name, had in written.items()),
        )
        yield counter(
            "recording_frames_written",
            "Frames that are safe in recordings.",
            (((name,), had.frames) for name, had in written.items()),
        )
        yield counter(
            "recording_frames_dropped",
            "Frames missing in recordings because their writer did not keep up.",
            (((name,), had.dropped) for name, had in written.items()),
        )
        yield counter(
            "recordings_failed",
            "Recordings that ended because they could not be written.",
            (((name,), had.failed) for name, had in written.items()),
        )
        try:
            free = shutil.disk_usage(self._recordings.library.folder).free
        except OSError:
            return
        yield single("recordings_free_bytes", "Free bytes on the disk of recordings.", free)
