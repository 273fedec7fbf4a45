"""Lines too faint for the pixel search, found by the matched filter and then fitted."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.detection.fit_candidates import fit_candidates
from compute.signal.detection.matched_filter import gaussian_filter
from compute.signal.detection.peak_detector import DetectionSettings, PeakDetector
from compute.signal.fit.cramer_rao import position_bounds
from compute.signal.fit.fit_reference import fit_lines
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise

PIXELS, WIDTH, LIGHT, AMBIENT = 200, 3.0, 1800.0, 200.0
NOISE = SensorNoise.of(5.0, 50.0, 100.0, 65535)
SEARCH = CentroidSettings(min_width_px=1, max_peaks=4)
FIT = FitSettings(search=SEARCH, width_px=WIDTH, width_log_sigma=0.0)
DETECTOR = PeakDetector(
    gaussian_filter(WIDTH), PIXELS, DetectionSettings(false_alarms_per_line=0.01), NOISE
)


def faint_lines(lines: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(40.0, PIXELS - 40.0, lines)
    # An area sampled finely: no function that the fit uses too.
    fine = (np.arange(PIXELS * 32) + 0.5) / 32.0 - 0.5
    share = np.exp(-0.5 * ((fine - truth[:, None]) / WIDTH) ** 2).reshape(lines, PIXELS, 32).sum(2)
    mean = AMBIENT + LIGHT * share / share.sum(axis=1, keepdims=True)
    electrons = rng.poisson(mean) + rng.normal(0.0, 50.0, mean.shape)
    return np.clip(np.rint(electrons / 5.0 + 100.0), 0, 65535).astype(np.uint16), truth


def test_finds_and_fits_what_the_pixel_search_misses() -> None:
    lines, truth = faint_lines(1500, 3)
    searched = find_peaks_reference(lines, SEARCH, NOISE)
    candidates = fit_candidates(DETECTOR.detect(lines), FIT)
    # Its highest pixel stands 4.6 deviations out, and the search asks for 6.
    assert (candidates.count >= 1).mean() > 0.99 > 0.5 > (searched.count >= 1).mean()

    fitted = fit_lines(lines, FIT, NOISE, candidates=candidates)
    error = np.nanmin(abs(fitted.position_px - truth[:, None]), axis=1)
    near = error < 4.0
    assert near.mean() > 0.99
    bound = position_bounds(truth[:, None], [LIGHT], AMBIENT, PIXELS, FIT, NOISE)[:, 0, 0]
    ratio = np.sqrt(np.mean(error[near] ** 2) / bound.mean())
    # Five standard errors of the root mean square of so many.
    assert ratio == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * len(lines)))


def test_candidates_keep_order_room_and_flags() -> None:
    # Heights out of order, so that the brightest are not the first.
    pixel = np.arange(PIXELS)
    line = np.full(PIXELS, 100.0)
    for place, height in ((30, 300), (70, 900), (110, 500), (150, 700), (180, 250)):
        line += height * np.exp(-0.5 * ((pixel - place) / WIDTH) ** 2)
    lines = np.rint(line)[None].astype(np.uint16)
    found = DETECTOR.detect(lines)
    assert found.count[0] == 5
    kept = fit_candidates(found, FIT)
    assert kept.count[0] == 4
    assert kept.position_px[0].tolist() == [30.0, 70.0, 110.0, 150.0]
    assert (kept.flags[0] & PeakFlag.TRUNCATED != 0).all()
    assert not (kept.flags & PeakFlag.MERGED).any()
    # The height of a line, and the width at a third of it.
    assert kept.amplitude[0, 1] == pytest.approx(900, rel=0.15)
    np.testing.assert_allclose(kept.width_px[0], 2.0 * np.sqrt(2.0 * np.log(3.0)) * WIDTH)


def test_lines_without_detections_and_wrong_widths() -> None:
    flat = np.full((3, PIXELS), 120, np.uint16)
    none = fit_candidates(DETECTOR.detect(flat), FIT)
    assert none.count.tolist() == [0, 0, 0]
    assert np.isnan(none.position_px).all()
    assert fit_lines(flat, FIT, NOISE, candidates=none).count.tolist() == [0, 0, 0]
    with pytest.raises(InvalidParameter, match="width_px is -1"):
        fit_candidates(DETECTOR.detect(flat), FIT, -1.0)
