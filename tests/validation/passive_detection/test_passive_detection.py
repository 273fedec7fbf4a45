"""Case passive-detection: measured points on their theory, and what the theory itself is."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from validation.all_cases import ALL_CASES
from validation.attenuation.case import CYLINDER_SNR
from validation.passive_detection.case import AVERAGED_RATE, averaged_scenes, curve
from validation.passive_detection.detection_rates import (
    FALSE_ALARMS,
    PIXELS,
    SIGNAL_TO_BACKGROUND,
    WIDTH_PX,
    Scene,
    alarms_by_skewness,
    by_filter,
    by_own_noise,
    by_pixel,
    filter_detection_probability,
    line_filter,
    pixel_detection_probability,
    pixel_threshold,
    scanned,
)
from validation.result_tables import TablesCase

pytestmark = pytest.mark.slow


SURE = 4.5
"""Standard errors that one of 60 correlated points exceeds once in 2,000 seeds."""


@pytest.mark.slow
@pytest.mark.parametrize("light", [1000.0, 6000.0])
def test_points_lie_on_the_theory(light: float) -> None:
    for matched, pixel in curve(Scene(light)):
        for point in (matched, pixel):
            assert abs(point.detections.deviations) < SURE
            assert abs(point.false_alarms.deviations) < SURE
        # The filter finds more at as many false alarms.
        assert matched.detections.expected > pixel.detections.expected
        # An answer beside the marker's own place counts too.
        assert matched.at_place < matched.detections.expected < matched.at_place + 0.12


def test_sums_of_lines_too_and_with_their_own_noise() -> None:
    for scene in averaged_scenes().values():
        if scene.lines not in (30, 100):
            continue
        point, pixel = by_filter(scene, AVERAGED_RATE), by_pixel(scene, AVERAGED_RATE)
        assert abs(point.detections.deviations) < SURE
        assert abs(pixel.detections.deviations) < SURE
        own = by_own_noise(scene, AVERAGED_RATE)
        assert point.detections.measured - 0.1 < own < point.detections.measured


def test_the_scene_is_the_thesiss_ratio() -> None:
    assert SIGNAL_TO_BACKGROUND == CYLINDER_SNR
    scene = Scene(10000.0)
    empty, marked, place = scanned(scene, 1)
    centred = np.abs(place - np.rint(place)) < 0.1
    top = marked[np.flatnonzero(centred), np.rint(place[centred]).astype(int)].mean()
    error = np.sqrt(scene.variance / centred.sum())
    assert top / empty.mean() == pytest.approx(SIGNAL_TO_BACKGROUND, abs=4.5 * error / 1e4 + 1e-4)
    assert empty.std() == pytest.approx(np.sqrt(scene.variance), rel=0.005)


def test_a_sum_of_lines_is_as_good_as_their_light() -> None:
    """As long as photons outweigh the reading, n lines are one of n times the light."""
    one, many = Scene(20000.0), Scene(200.0, 100)
    assert many.level == one.level
    assert many.snr < one.snr
    assert many.snr / Scene(200.0).snr == pytest.approx(10.0)


def test_theory_of_a_marker_without_light_is_that_of_noise() -> None:
    """Near a place the answers exceed a threshold as often as the false alarms there say."""
    dark = Scene(1e-9)
    for rate in FALSE_ALARMS[1:]:
        threshold = by_threshold(rate)
        near = filter_detection_probability(dark, threshold)
        single = float(norm.sf(threshold))
        # Of the nine answers near by, more than one is enough, and all are not independent.
        assert single < near < 9.0 * single
        pixel = pixel_detection_probability(dark, pixel_threshold(rate))
        expected = 1.0 - norm.cdf(pixel_threshold(rate)) ** 8
        assert pixel == pytest.approx(expected, rel=1e-6)


def by_threshold(rate: float) -> float:
    return by_filter(Scene(1000.0), rate).threshold_sigma


def test_skewness_of_photon_noise() -> None:
    taps = line_filter().taps / line_filter().norm
    rng = np.random.default_rng(1)
    answers = rng.poisson(100.0, (200_000, len(taps))) @ taps
    skew = float(np.mean((answers - answers.mean()) ** 3)) / float(answers.std()) ** 3
    # Read noise makes it less skew, at 100 electrons by (1 + read^2 / 100)^1.5.
    scene = Scene(100.0)
    expected = np.log(alarms_by_skewness(scene, 4.0)) * 6.0 / 64.0
    assert skew * (100.0 / scene.variance) ** 1.5 == pytest.approx(
        expected, abs=4.5 * np.sqrt(6.0 / 200_000)
    )


@pytest.mark.slow
def test_the_case_and_its_picture(tmp_path: Path) -> None:
    case = ALL_CASES["passive-detection"]
    assert isinstance(case, TablesCase)
    tables, findings = case.compute_tables()
    assert [len(table.rows) for table in tables] == [16, 16, 16, 6]
    assert len(findings) == 6
    assert (PIXELS, WIDTH_PX) == (640, 2.0)
    assert case.picture is not None
    case.picture(tmp_path / "passive.png")
    assert (tmp_path / "passive.png").read_bytes().startswith(b"\x89PNG")
