"""How a device's peaks are measured: fits beside centres of gravity, shadows, honest deviations."""

import json
import logging
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.optics.profiles.profile_loader import load_profile
from compute.optics.profiles.profile_optics import light_source, mask_optics, profile_optics
from compute.planning.cramer_rao import centroids
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from hardware.driver import DeviceDescription, PeakMethod
from hardware.recording.writer import RecordingWriter
from hardware.replay import ReplayDriver
from hardware.simulated.driver import RenderedDriver, SimulatedDriver
from hardware.simulated.profile_driver import ProfileDriver
from hardware.simulated.profile_settings import ProfileSettings
from hardware.simulated.scenes import StillPoints
from hardware.simulated.settings import SimulationSettings
from service.api.devices.nominal_calibration import nominal_calibration
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.detection_stage import (
    FREE_WIDTH_FIT,
    DetectionStage,
    ExpectedScans,
    expected_scans,
    peak_method,
)
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor
from service.protocols.stream.messages import (
    StreamBatch,
    describe_message,
    encode,
)
from tests.service.pipeline.test_pipeline_manager import nominal

Array = NDArray[np.float64]

METHODS: tuple[PeakMethod, ...] = ("fit", "centroid")
FRAMES = 800
SIMULATION = SimulationSettings(realtime=False, duration_s=FRAMES / 1000.0)
WINDOW, GRAY = "coda-mpx30", "mitchelson-1971"
PLACES = 40


def processed(driver: RenderedDriver | ReplayDriver, processor: FrameProcessor) -> list[FrameBatch]:
    driver.open()
    frames = driver.frames()
    batches = []
    while some := list(islice(frames, MAX_FRAMES)):
        batches.append(processor.process(some))
    driver.close()
    return batches


@lru_cache(maxsize=2)
def bar_errors(method: PeakMethod) -> tuple[Array, Array]:
    """Errors of the points of the rotating bar, (N, 3) [mm], and their normalised squares."""
    driver = SimulatedDriver("sim", replace(SIMULATION, peaks=method))
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("c", nominal()))
    errors, squares = [], []
    for batch in processed(driver, processor):
        estimates = zip(batch.points.position_mm, batch.points.covariance_mm2, strict=True)
        for owner, (position, covariance) in zip(batch.owner, estimates, strict=True):
            frame = batch.frames[owner]
            truth = SIMULATION.scene.points(frame.exposure_device_ns * 1e-9)[frame.marker]
            error = position - truth
            errors.append(error)
            squares.append(error @ np.linalg.solve(covariance, error))
    return np.array(errors), np.array(squares)


def test_points_by_fit_scatter_less_on_the_same_frames() -> None:
    """Prints both methods' errors."""
    variance = {}
    for method in METHODS:
        errors, squares = bar_errors(method)
        assert len(errors) == FRAMES
        rms = np.sqrt((errors**2).mean(axis=0))
        variance[method] = (errors**2).mean(axis=0)
        print(f"{method}: {rms} mm RMS, normalised square {squares.mean():.2f}")
    # Five standard deviations of the ratio of two independent variances; these depend.
    assert (variance["fit"] < np.exp(-5.0 * np.sqrt(4.0 / FRAMES)) * variance["centroid"]).all()


def test_the_covariance_of_points_by_fit_is_honest() -> None:
    _, squares = bar_errors("fit")
    assert squares.mean() == pytest.approx(3.0, abs=5.0 * np.sqrt(6.0 / FRAMES))


@pytest.mark.parametrize("method", METHODS)
def test_a_replay_has_the_same_peaks(tmp_path: Path, method: PeakMethod) -> None:
    settings = replace(SIMULATION, duration_s=0.1, peaks=method)
    check_replay(SimulatedDriver("sim", settings), tmp_path / "bar.h5")


@pytest.mark.slow
@pytest.mark.parametrize("profile", [WINDOW, "bar"])
def test_a_replay_knows_the_profile(tmp_path: Path, profile: str) -> None:
    settings = ProfileSettings(optics="exact", realtime=False, duration_s=0.1, frame_rate_hz=100)
    driver = ProfileDriver("one", load_profile(profile), settings)
    check_replay(driver, tmp_path / "profile.h5")


def check_replay(driver: RenderedDriver, path: Path) -> None:
    driver.open()
    with RecordingWriter(path, driver.description) as writer:
        for frame in driver.frames():
            writer.append(frame)
    live = processed(driver, FrameProcessor("a", driver.description, "cpu"))
    replay = ReplayDriver("a", path, speed=None)
    replay.open()
    processor = FrameProcessor("a", replay.description, "cpu")
    played = processed(replay, processor)
    assert sum(batch.peaks.count.sum() for batch in live) > 0
    for one, other in zip(live, played, strict=True):
        for name, values in vars(one.peaks).items():
            np.testing.assert_array_equal(values, getattr(other.peaks, name), name)


def places(profile: str, seed: int = 7) -> tuple[tuple[float, float, float], ...]:
    volume = load_profile(profile).volume
    share = np.random.default_rng(seed).uniform(-0.5, 0.5, (PLACES, 3))
    points = np.array(volume.centre_mm) + share * np.array(volume.size_mm)
    return tuple((float(x), float(y), float(z)) for x, y, z in points)


def profile_errors(name: str, method: PeakMethod = "fit") -> tuple[Array, Array, NDArray[np.int32]]:
    """Errors of the readings of random places, (N, S) [px], over their deviations; flags."""
    profile, points = load_profile(name), places(name)
    rate = min(100.0, profile.rates.line_rate_hz)
    settings = ProfileSettings(
        scene=StillPoints(points), optics="exact", realtime=False, illumination="strobed",
        frame_rate_hz=rate, duration_s=PLACES / rate, peaks=method,
    )  # fmt: skip
    driver = ProfileDriver(name, profile, settings)
    batches = processed(driver, FrameProcessor(name, driver.description, "cpu"))
    source, where = light_source(profile), np.array(points)
    mask = mask_optics(profile, source)
    if mask is not None:
        true = mask.readings(where)
    else:
        lines = profile_optics(profile, "exact").solid_angles(where)
        true, _ = centroids(lines, profile.pixels.count)
    brightest = [np.nan_to_num(batch.peaks.amplitude, nan=-1.0).argmax(axis=1) for batch in batches]

    def of(values: str) -> NDArray[Any]:
        chosen = [
            np.take_along_axis(getattr(batch.peaks, values), best[:, None], axis=1)
            for batch, best in zip(batches, brightest, strict=True)
        ]
        return np.concatenate(chosen).reshape(true.shape)

    flags = of("flags")
    errors = of("position_px") - true
    errors[(flags & (PeakFlag.CLIPPED | PeakFlag.SATURATED)) != 0] = np.nan
    if mask is not None:
        errors = of("position_px") - true
    return errors, errors / of("sigma_px"), flags


def test_shadows_are_read_where_they_are() -> None:
    """Prints the errors of the shadows of places all over the volume."""
    errors, relative, _ = profile_errors(WINDOW)
    assert np.isfinite(errors).all()
    rms = np.sqrt(np.mean(errors**2))
    square = relative**2
    most = np.abs(relative).max()
    print(f"{WINDOW}: {rms:.4f} px RMS, normalised {square.mean():.2f}, at most {most:.1f}")
    assert most < 5.0
    assert square.mean() < 1.0
    # And the deviation is no excuse: a hundredth of a pixel.
    assert rms < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bar", "thesis-5.1", "thesis-5.9", "optotrak"])
def test_traced_lines_are_read_better_by_fit(name: str) -> None:
    """Prints the errors of both methods, beside the centre of gravity of all light."""
    rms, missing = {}, {}
    for method in METHODS:
        errors, relative, flags = profile_errors(name, method)
        seen = np.isfinite(errors)
        rms[method], missing[method] = np.sqrt(np.nanmean(errors**2)), 1.0 - seen.mean()
        square = relative[seen] ** 2
        print(
            f"{name}, {method}: {rms[method]:.4f} px RMS, none in {missing[method]:.0%}, "
            f"normalised {square.mean():.2f}"
        )
        # No deviation a fifth too large, nor too small by more than chance.
        assert square.mean() > 0.7
        assert square.mean() < 1.0 + 5.0 * square.std() / np.sqrt(square.size)
        assert not (flags & PeakFlag.UNFITTED).any()
    assert rms["fit"] < rms["centroid"]
    assert missing["fit"] <= missing["centroid"]


def test_points_of_shadows() -> None:
    profile = load_profile(WINDOW)
    points = places(WINDOW)[:8]
    settings = ProfileSettings(
        scene=StillPoints(points), realtime=False, duration_s=0.16, frame_rate_hz=100
    )
    driver = ProfileDriver("one", profile, settings)
    processor = FrameProcessor("one", driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("c", nominal_calibration(profile)))
    (batch,) = processed(driver, processor)
    messages = list(StreamBatch(batch).messages(frozenset({"points", "peaks"})))
    for message in messages:
        (point,) = message["points"]
        error = np.subtract(point["position_mm"], points[message["marker"]])
        # chi2 of 3 at 1e-6
        assert error @ np.linalg.solve(point["covariance_mm2"], error) < 30.7
        assert np.linalg.norm(error) < 1.0
        # Poor fits are accounted for in the deviations.
        assert "suspect-peak" not in point["flags"]
        assert json.loads(encode(message, "json"))["peaks"][0]["reduced_chi2"] > 0.0


def description(**changes: Any) -> DeviceDescription:
    driver = SimulatedDriver("sim", SIMULATION)
    return replace(driver.description, **changes)


@pytest.mark.parametrize(
    ("changes", "method"),
    [
        ({}, "fit"),
        ({"line_sigma_px": None}, "fit"),
        ({"peaks": "centroid"}, "centroid"),
        ({"line_sigma_px": 20.0}, "centroid"),
        ({"line_sigma_px": 0.1}, "centroid"),
        ({"readout": "coded-window"}, "shadow"),
        ({"readout": "gray-tracks"}, None),
    ],
)
def test_methods(changes: dict[str, Any], method: str | None) -> None:
    assert peak_method(description(**changes)) == method
    assert describe_message(description(**changes))["method"] == method


@pytest.mark.parametrize("sigma_px", [0.1, 20.0])
def test_lines_beyond_the_fits_widths_are_measured(sigma_px: float) -> None:
    still = StillPoints(((0.0, 0.0, 1500.0),))
    settings = replace(SIMULATION, scene=still, duration_s=0.01, spot_sigma_px=sigma_px)
    driver = SimulatedDriver("sim", replace(settings, signal_electrons=1e6))
    (batch,) = processed(driver, FrameProcessor("sim", driver.description, "cpu"))
    assert not (batch.peaks.flags & PeakFlag.UNFITTED).any()
    assert np.isnan(batch.peaks.reduced_chi2).all()
    (message, *_) = StreamBatch(batch).messages(frozenset({"peaks"}))
    assert all(peak["reduced_chi2"] is None for peak in message["peaks"])
    encode(message, "json")


def test_what_no_profile_explains(caplog: pytest.LogCaptureFixture) -> None:
    """A recording of a profile that is not here, or of other sensors meanwhile, still plays."""
    with caplog.at_level(logging.WARNING):
        for name in ("not-here", "../bar.toml", "optotrak"):
            model = expected_scans(description(profile=name))
            assert (model.volume, model.templates) == (None, ())
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 3
    finding = DetectionStage(description(profile="not-here"), 1, ExpectedScans(), "cpu")
    assert finding.flag_policy.lookup.suspect[PeakFlag.POOR_FIT]
    assert finding.error_px is None
    shadows = DetectionStage(description(readout="coded-window"), 1, ExpectedScans())
    assert not shadows.reads
    assert len(shadows.find(np.zeros((4, 2048), np.uint16))) == 4


def test_traced_lines_are_not_split() -> None:
    """Prints how many of the profile bar's are: with one Gaussian each, with further ones."""
    driver = ProfileDriver("bar", load_profile("bar"), ProfileSettings())
    known, volume = driver.description, expected_scans(driver.description).volume
    assert volume is not None
    noise = SensorNoise.of(
        known.electrons_per_count,
        known.read_noise_electrons,
        known.offset_counts,
        2**known.bits - 1,
    )
    split, rms = {}, {}
    for further in (False, True):
        settings = replace(FREE_WIDTH_FIT, further_peaks=further)
        finder = FitFinder(len(volume.lines), 2048, settings, noise, device="cpu")
        peaks = finder.find(volume.lines)
        split[further] = float((peaks.count > 1).mean())
        rms[further] = float(np.sqrt(np.nanmean(volume.errors_px(peaks) ** 2)))
        print(f"bar, further {further}: {split[further]:.0%} split, {rms[further]:.4f} px RMS")
    assert split[False] == 0.0
    assert split[True] > 0.5
    assert rms[False] < 0.1 * rms[True]


@pytest.mark.parametrize("method", METHODS)
def test_what_a_method_errs_by_is_in_its_deviations(method: PeakMethod) -> None:
    profile = load_profile("bar")
    driver = ProfileDriver("bar", profile, ProfileSettings(peaks=method))
    model = expected_scans(driver.description)
    assert model.volume is not None
    known = DetectionStage(driver.description, 64, model, "cpu")
    assert known.error_px is not None
    assert not known.flag_policy.lookup.suspect[PeakFlag.POOR_FIT]
    plain = DetectionStage(driver.description, 64, ExpectedScans(), "cpu")
    assert plain.flag_policy.lookup.suspect[PeakFlag.POOR_FIT]
    lines = model.volume.lines[: 4 * 64]
    one, other = known.find(lines), plain.find(lines)
    np.testing.assert_array_equal(one.position_px, other.position_px)
    error_px, known.error_px = known.error_px, None
    alone = known.find(lines)
    added = np.sqrt(one.sigma_px[:, 0] ** 2 - alone.sigma_px[:, 0] ** 2).reshape(-1, 4)
    np.testing.assert_allclose(np.nanmedian(added, axis=0), error_px, rtol=1e-3)
    # Whoever does not know the shape has a larger deviation where it does not fit.
    assert not (alone.sigma_px > other.sigma_px * (1.0 + 1e-9)).any()
