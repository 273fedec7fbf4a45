"""The newest scans of a running device: its own peaks, and the fits behind them."""

from typing import TYPE_CHECKING, Any

import pytest

from compute.errors import InvalidParameter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.api.line_scans import live_scans as module
from service.api.line_scans.live_scans import ScanTap, live_scans
from service.pipeline.active_calibration import LiveBadPixel
from service.pipeline.frame_processor import FrameProcessor
from service.problems.errors import DeviceNotRunning
from service.protocols.stream.hub import Hub
from tests.service.api.quality.batches import strobed_batch

if TYPE_CHECKING:
    from hardware.line_frame import LineFrame


class Live:
    """A device of which one batch comes."""

    def __init__(self) -> None:
        driver = SimulatedDriver("sim", SimulationSettings(duration_s=0.006, realtime=False))
        driver.open()
        self.frames: list[LineFrame] = list(driver.frames())
        self.processor = FrameProcessor("sim", driver.description, "cpu")
        self.taps: list[Any] = []
        self.streams = Hub()
        self.device_id, self.description, self.connected = "sim", driver.description, True

    def session(self, _device_id: str) -> Any:
        return self

    @property
    def search_model(self) -> Any:
        return self.processor.detection.search_model

    @property
    def method(self) -> Any:
        return self.processor.detection.method

    def attach(self, tap: Any) -> None:
        self.taps.append(tap)
        tap.offer(self.processor.process(self.frames))

    def detach(self, tap: Any) -> None:
        self.taps.remove(tap)


@pytest.fixture
def live() -> Any:
    return Live()


def test_scans_are_the_newest_exposure_with_the_peaks_of_the_pipeline(live: Any) -> None:
    found = live_scans(live, "sim", None, None, None)
    newest = live.frames[-1]
    peaks = live.processor.process([newest]).peaks
    assert found.sequence == newest.sequence
    assert [scan.counts for scan in found.scans] == newest.lines.tolist()
    assert [scan.peaks[0].position_px for scan in found.scans] == pytest.approx(
        peaks.position_px[:, 0].tolist()
    )
    assert all(scan.windows is None for scan in found.scans)
    assert live.taps == []


def test_fit_of_the_named_sensor_is_that_of_its_peaks(live: Any) -> None:
    scan = live_scans(live, "sim", None, None, "horizontal").scans[1]
    assert scan.windows is not None
    [window] = scan.windows
    assert window.position_px[0] == pytest.approx(scan.peaks[0].position_px, abs=1e-3)
    assert window.chi2 is not None
    assert window.chi2 / window.dof < 3.0
    assert scan.threshold_counts is not None
    assert scan.background_counts < scan.threshold_counts < max(scan.counts)


def test_masked_pixels_are_told_and_left_out_of_the_fit(live: Any) -> None:
    position = live_scans(live, "sim", None, None, None).scans[0].peaks[0].position_px
    bad = round(position)
    since = LiveBadPixel("vertical", bad, "hot", None)  # type: ignore[arg-type]
    live.processor.detection.set_pixels({}, [since])
    scan = live_scans(live, "sim", None, None, "vertical").scans[0]
    assert scan.masked_pixels == [bad]
    assert scan.windows is not None
    [window] = scan.windows
    assert not window.used[bad - window.first_px]
    assert window.position_px[0] == pytest.approx(scan.peaks[0].position_px, abs=1e-3)


def test_unknown_sensor_is_refused_with_those_that_there_are(live: Any) -> None:
    with pytest.raises(InvalidParameter, match="vertical, horizontal"):
        live_scans(live, "sim", None, None, "third")


def test_exposure_that_does_not_come_is_refused_in_time(live: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(module, "TIMEOUT_S", 0.05)
    with pytest.raises(DeviceNotRunning, match="no exposure of marker 9"):
        live_scans(live, "sim", None, 9, None)
    assert live.taps == []


@pytest.mark.parametrize(
    ("after", "marker", "sequence"),
    [(None, None, 19), (None, 0, 18), (18, None, 19), (18, 0, None), (19, None, None)],
)
def test_tap_takes_the_newest_exposure_that_is_wanted(
    after: int | None, marker: int | None, sequence: int | None
) -> None:
    tap = ScanTap(after, marker)
    tap.offer(strobed_batch(range(20)))
    assert tap.ended.is_set() == (sequence is not None)
    if tap.found is not None:
        batch, index = tap.found
        assert batch.frames[index].sequence == sequence
        tap.offer(strobed_batch(range(20, 30)))
        assert tap.found == (batch, index)
