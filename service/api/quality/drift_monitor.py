"""DriftMonitor: a thread that taps running devices and stores statistics of each interval."""

import logging
from collections.abc import Callable
from datetime import UTC, datetime
from threading import Event, Thread
from typing import Final

from compute.errors import LumilineError
from service.api.quality.interval_statistics_tap import IntervalStatisticsTap, IntervalSums
from service.api.quality.schema import WatchSettings
from service.api.quality.store import watch_of
from service.database.engine import Database
from service.database.models import CalibrationRow, WatchSampleRow
from service.pipeline.interface import Pipeline, RunningDevice

_log = logging.getLogger(__name__)

LOOK_S: Final = 2.0
MIN_SECONDS: Final = 5.0
"""Less than this of a calibration is no value."""


class DriftMonitor:
    """Watches all running devices.

    Args:
        database: where settings are read and samples stored.
        live: the live pipeline.
        look_s: how often it looks which devices run.
        is_mine: whether this server watches a device, of several that may see it.
    """

    def __init__(
        self,
        database: Database,
        live: Pipeline,
        sample_interval_s: float = LOOK_S,
        is_mine: Callable[[str], bool] = lambda _: True,
    ) -> None:
        self._is_mine = is_mine
        self._database = database
        self._live = live
        self._sample_interval_s = sample_interval_s
        self._taps: dict[str, tuple[RunningDevice, IntervalStatisticsTap]] = {}
        self._ended = Event()
        self._thread = Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Store what there is and end the thread."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(10.0)

    def _run(self) -> None:
        while not self._ended.wait(self._sample_interval_s):
            self.sample()
        self.sample(last=True)

    def sample(self, *, last: bool = False) -> None:
        """Tap devices that have started and store intervals that are due; ``last``: store all."""
        for device_id in {*self._live.statuses(), *self._taps}:
            try:
                self._sample_device(device_id, last=last)
            except LumilineError as error:
                _log.warning("device %s is not watched now: %s", device_id, error.detail)
            except Exception:  # noqa: BLE001 - a watch that fails must not end the others
                _log.exception("device %s: its watch failed", device_id)

    def _sample_device(self, device_id: str, *, last: bool) -> None:
        with self._database.read() as session:
            settings = watch_of(session, device_id)
        running = self._session(device_id)
        known = self._taps.get(device_id)
        wanted = None if settings.reference is None else settings.reference.marker
        if known is not None:
            watched, tap = known
            changed = watched is not running or tap.reference != wanted
            if changed or last or tap.seconds >= settings.interval_s:
                self._store(device_id, tap, settings)
            if changed:
                watched.detach(tap)
                del self._taps[device_id]
                known = None
        if known is None and running is not None and not last:
            tap = IntervalStatisticsTap(wanted)
            running.attach(tap, sampled=True)
            self._taps[device_id] = (running, tap)

    def _session(self, device_id: str) -> RunningDevice | None:
        if not self._is_mine(device_id):
            return None
        try:
            return self._live.session(device_id)
        except LumilineError:
            return None

    def _store(self, device_id: str, tap: IntervalStatisticsTap, settings: WatchSettings) -> None:
        seen = tap.take()
        least = min(MIN_SECONDS, settings.interval_s / 2)
        rows = [sums for sums in seen if sums.points and sums.seconds >= least]
        if not rows:
            return
        link = self._live.status(device_id).link
        temperature_c = None if link is None else link.temperature_c
        try:
            with self._database.write() as session:
                for sums in rows:
                    # The device, or the calibration, may have been deleted meanwhile.
                    if session.get(CalibrationRow, sums.calibration_id) is not None:
                        session.add(_sample(device_id, sums, temperature_c))
        except LumilineError:
            tap.put_back(rows)
            raise


def _sample(device_id: str, sums: IntervalSums, temperature_c: float | None) -> WatchSampleRow:
    place = sums.reference_mm
    return WatchSampleRow(
        device_id=device_id,
        calibration_id=sums.calibration_id,
        table_id=sums.table_id,
        at=datetime.now(UTC),
        seconds=sums.seconds,
        points=sums.points,
        residual_sigma=sums.residual_sigma,
        inconsistent=sums.inconsistent,
        reference_mm=None if place is None else place.tolist(),
        reference_scatter_mm=sums.reference_scatter_mm,
        temperature_c=temperature_c,
    )
