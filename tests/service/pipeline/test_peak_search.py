"""What the live search finds: faint lines, neighbours, and no hot pixel; what has no fit."""

from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.optics.profiles.profile_loader import load_profile
from compute.planning.volume_scans import VolumeScans
from compute.signal.peaks import PeakFlag
from hardware.driver import DeviceDescription, SensorDescription
from hardware.simulated.profile_driver import ProfileDriver
from hardware.simulated.profile_settings import ProfileSettings
from hardware.simulated.scenes import StillPoints
from hardware.simulated.settings import SimulationSettings
from service.api.devices.nominal_calibration import nominal_calibration
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.detection_stage import DetectionStage, ExpectedScans
from service.pipeline.frame_processor import FrameProcessor

Array = NDArray[np.float64]

PIXELS, LINES, SIGMA_PX = 256, 400, 2.0
DETECTOR = SimulationSettings()  # with its default noise
KNOWN: tuple[float | None, ...] = (SIGMA_PX, None)


def description(line_sigma_px: float | None, **changes: Any) -> DeviceDescription:
    return replace(
        DeviceDescription(
            "one", (SensorDescription("s", PIXELS, 10.0),), 1000.0, DETECTOR.bits,
            DETECTOR.electrons_per_count, DETECTOR.read_noise_electrons, DETECTOR.offset_counts, 0,
        ),
        line_sigma_px=line_sigma_px,
        **changes,
    )  # fmt: skip


def exposures(
    places_px: tuple[float, ...], electrons: tuple[float, ...], seed: int = 3
) -> tuple[NDArray[np.uint16], Array]:
    """Lines of light at all sub-pixel phases, (LINES, PIXELS), and where they are."""
    rng = np.random.default_rng(seed)
    true = np.array(places_px) + rng.uniform(0.0, 1.0, (LINES, 1))
    edges = (np.arange(PIXELS + 1) - 0.5 - true[..., None]) / SIGMA_PX
    light = (np.array(electrons)[:, None] * np.diff(ndtr(edges))).sum(axis=1)
    collected = rng.poisson(light + DETECTOR.ambient_electrons)
    noisy = collected + rng.normal(0.0, DETECTOR.read_noise_electrons, light.shape)
    counts = np.rint(noisy / DETECTOR.electrons_per_count + DETECTOR.offset_counts)
    return counts.clip(0, 2**DETECTOR.bits - 1).astype(np.uint16), true


def check_errors(errors_px: Array, sigma_px: Array) -> None:
    """No bias, and deviations that are what the errors show, to five standard errors."""
    relative = errors_px / sigma_px
    assert np.abs(relative.mean(axis=0)).max() < 5.0 / np.sqrt(LINES)
    assert np.abs((relative**2).mean(axis=0) - 1.0).max() < 5.0 * np.sqrt(2.0 / LINES)


@pytest.mark.parametrize("known", KNOWN)
@pytest.mark.parametrize("electrons", [2000.0, 20_000.0])
def test_faint_lines_are_found_once(known: float | None, electrons: float) -> None:
    """2000 electrons are 11 deviations of the noise at the line's top."""
    lines, true = exposures((100.0,), (electrons,))
    peaks = DetectionStage(description(known), LINES, ExpectedScans(), "cpu").find(lines)
    assert (peaks.count == 1).all()
    assert not (peaks.flags & PeakFlag.UNFITTED).any()
    check_errors(peaks.position_px[:, :1] - true, peaks.sigma_px[:, :1])


@pytest.mark.parametrize("known", KNOWN)
@pytest.mark.parametrize("share", [1.0, 0.2])
@pytest.mark.parametrize("deviations", [7.0, 10.0])
def test_neighbours_are_two(known: float | None, share: float, deviations: float) -> None:
    lines, true = exposures((100.0, 100.0 + deviations * SIGMA_PX), (40_000.0, share * 40_000.0))
    check_two(DetectionStage(description(known), LINES, ExpectedScans(), "cpu"), lines, true)


@pytest.mark.parametrize("known", KNOWN)
def test_equal_neighbours_six_deviations_apart(known: float | None) -> None:
    lines, true = exposures((100.0, 100.0 + 6.0 * SIGMA_PX), (40_000.0, 40_000.0))
    check_two(DetectionStage(description(known), LINES, ExpectedScans(), "cpu"), lines, true)


def test_neighbours_of_known_shape_are_two_where_they_show_one() -> None:
    lines, true = exposures((100.0, 100.0 + 3.0 * SIGMA_PX), (40_000.0, 8_000.0))
    check_two(DetectionStage(description(SIGMA_PX), LINES, ExpectedScans(), "cpu"), lines, true)


def check_two(finding: DetectionStage, lines: NDArray[np.uint16], true: Array) -> None:
    peaks = finding.find(lines)
    assert (peaks.count == 2).all()
    # A poor fit by chance is one line in ten thousand.
    other_flags = peaks.flags & ~int(PeakFlag.POOR_FIT)
    assert not finding.flag_policy.lookup.suspect[other_flags].any()
    assert ((peaks.flags & PeakFlag.POOR_FIT) != 0).mean() < 0.01
    check_errors(peaks.position_px[:, :2] - true, peaks.sigma_px[:, :2])


@pytest.mark.parametrize("known", KNOWN)
def test_a_hot_pixel_is_no_line(known: float | None) -> None:
    lines, true = exposures((100.0,), (20_000.0,))
    lines[:, 30] = 0.9 * (2**DETECTOR.bits - 1)
    peaks = DetectionStage(description(known), LINES, ExpectedScans(), "cpu").find(lines)
    assert (peaks.count == 1).all()
    check_errors(peaks.position_px[:, :1] - true, peaks.sigma_px[:, :1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["thesis-5.9", "optotrak"])
def test_a_hot_pixel_is_no_marker(name: str) -> None:
    """Of a strobed marker whose lines are the faintest of the volume, on one of the sensors."""
    profile = load_profile(name)
    shift = np.array([0.3, 0.3, 0.45]) * profile.volume.size_mm
    x, y, z = np.array(profile.volume.centre_mm) + shift
    settings = ProfileSettings(
        scene=StillPoints(((float(x), float(y), float(z)),)), optics="exact", realtime=False,
        illumination="strobed", frame_rate_hz=30.0, duration_s=0.15,
    )  # fmt: skip
    driver = ProfileDriver(name, profile, settings)
    driver.open()
    frames = list(islice(driver.frames(), 4))
    driver.close()
    processor = FrameProcessor(name, driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("c", nominal_calibration(profile)))
    hot = [frame.lines.copy() for frame in frames]
    for lines in hot:
        lines[0, 150] = 0.9 * (2**driver.description.bits - 1)
    clean = processor.process(frames).points
    other = processor.process(
        [replace(frame, lines=lines) for frame, lines in zip(frames, hot, strict=True)]
    ).points
    assert np.isfinite(clean.position_mm).all()
    np.testing.assert_array_equal(other.position_mm, clean.position_mm)


@pytest.mark.parametrize("method", ["fit", "centroid"])
def test_widths_are_those_at_a_third(method: Any) -> None:
    lines, _ = exposures((100.0,), (60_000.0,))
    finding = DetectionStage(description(None, peaks=method), LINES, ExpectedScans(), "cpu")
    width = finding.find(lines).width_px[:, 0] / SIGMA_PX
    # Pixels and straight lines between them widen that of the centre of gravity by 3 %.
    assert width.mean() == pytest.approx(2.0 * np.sqrt(2.0 * np.log(3.0)), rel=0.05)


def test_what_has_no_fit_has_an_error_of_its_own() -> None:
    """Lines whose readings are 0.1 px off, and a plateau at full scale that is 3 px off."""
    lines, true = exposures((100.0,), (40_000.0,))
    lines[0] = DETECTOR.offset_counts
    lines[0, 40:200] = 2**DETECTOR.bits - 1
    true[0] = 119.5
    readings = true + 0.1
    readings[0] = true[0] + 3.0
    volume = VolumeScans(lines, readings, 2**DETECTOR.bits)
    plain = DetectionStage(description(None), LINES, ExpectedScans(), "cpu")
    finding = DetectionStage(description(None), LINES, ExpectedScans(volume), "cpu")
    peaks, own = finding.find(lines), plain.find(lines)
    unfitted = (peaks.flags[:, 0] & PeakFlag.UNFITTED) != 0
    assert unfitted.tolist() == [True] + [False] * (LINES - 1)
    assert finding.error_px is not None
    noise = np.sqrt(np.mean(own.sigma_px[1:, 0] ** 2))
    assert finding.error_px[0] == pytest.approx(np.hypot(0.1, noise), rel=5.0 / np.sqrt(LINES))
    assert finding.unfitted_error_px == pytest.approx(3.0, abs=0.01)
    error_px, finding.error_px = finding.error_px, None
    alone = finding.find(lines)  # a stage that knows no shape widens misfits besides
    added = np.sqrt(peaks.sigma_px[:, 0] ** 2 - alone.sigma_px[:, 0] ** 2)
    assert added[0] == pytest.approx(finding.unfitted_error_px, rel=1e-3)
    assert added[1:] == pytest.approx(error_px[0], rel=1e-3)
