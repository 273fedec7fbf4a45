"""CareCollector: metrics of calibrations' age and drift, backups and failed log-ins."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from prometheus_client import Metric
from prometheus_client.registry import Collector
from sqlalchemy import func, select

from service.backup.files import last_backup
from service.database.engine import Database
from service.database.models import ActiveCalibrationRow, CalibrationRow, DriftCheckRow
from service.problems.errors import NotReady
from service.protocols.metrics.collectors import counter, gauge, single


class CareCollector(Collector):
    """Reads the database, and the note of the last backup.

    Args:
        database: the server's.
        data_dir: where the note of the last backup is.
        failed_logins: returns the log-ins that failed since the server's start.
    """

    def __init__(
        self, database: Database, data_dir: Path, failed_logins: Callable[[], int]
    ) -> None:
        self._database = database
        self._data_dir = data_dir
        self._failed_logins = failed_logins

    def collect(self) -> Iterator[Metric]:
        """Yield what there is; without the database nothing of calibrations."""
        yield counter(
            "logins_failed", "Requests with keys or tokens that were not valid.",
            [((), self._failed_logins())], (),
        )  # fmt: skip
        at = last_backup(self._data_dir)
        yield single(
            "last_backup_timestamp_seconds",
            "When `lumiline backup --files` last wrote a whole backup; 0: never.",
            0.0 if at is None else at.timestamp(),
        )
        with suppress(NotReady):  # logged there
            yield from self._calibrations()

    def _calibrations(self) -> Iterator[Metric]:
        now = datetime.now(UTC)
        newest = (
            select(DriftCheckRow.calibration_id, func.max(DriftCheckRow.created_at).label("at"))
            .group_by(DriftCheckRow.calibration_id)
            .subquery()
        )
        active = select(
            ActiveCalibrationRow.device_id, CalibrationRow.id, CalibrationRow.created_at
        ).join(CalibrationRow, CalibrationRow.id == ActiveCalibrationRow.calibration_id)
        checks = select(
            DriftCheckRow.device_id, DriftCheckRow.calibration_id, DriftCheckRow.good,
            DriftCheckRow.created_at,
        ).join(
            newest,
            (newest.c.calibration_id == DriftCheckRow.calibration_id)
            & (newest.c.at == DriftCheckRow.created_at),
        )  # fmt: skip
        with self._database.read() as session:
            used = {device: (name, created) for device, name, created in session.execute(active)}
            newest_checks = {
                device: (good, created)
                for device, name, good, created in session.execute(checks)
                if used.get(device, ("", now))[0] == name
            }
        yield gauge(
            "calibration_age_seconds",
            "Since the calibration was made that a device uses.",
            (((device,), (now - created).total_seconds()) for device, (_, created) in used.items()),
        )
        yield gauge(
            "drift_check_good",
            "1 when the newest drift check of the calibration in use found that it holds, 0 when "
            "not; none: it was never checked.",
            (((device,), float(good)) for device, (good, _) in newest_checks.items()),
        )
        yield gauge(
            "drift_check_age_seconds",
            "Since the newest drift check of the calibration that a device uses.",
            (
                ((device,), (now - created).total_seconds())
                for device, (_, created) in newest_checks.items()
            ),
        )
