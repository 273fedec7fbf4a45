"""The thesis's Tests 4.1 and 4.2, rendered: the peaks of Table 4.5 are there."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import find_peaks

from compute.optics.detector_array import DetectorArray
from compute.optics.ideal_optics import IdealOptics
from compute.optics.pixel_solid_angles import stripe_images
from validation.signal_chain.background import background_scans
from validation.signal_chain.target_scenes import (
    ACTIVE_PEAK,
    PEAK_CENTROIDS_PX,
    PEAK_MAXIMA_PX,
    PIXELS,
    TargetScene,
    scene_of_test_4_1,
    scene_of_test_4_2,
)

Array = NDArray[np.float64]
LINES = 300
"""Lines averaged, as in section 3.6 ("as many as 300 lines")."""


def rendered(scene: TargetScene, seed: int = 1) -> tuple[Array, Array]:
    """Return one line, and the mean of 300, less background and offset [counts]."""
    points, per_sr = scene.photoelectrons_per_sr()
    optics = IdealOptics(
        [scene.sensor],
        spot_sigma_px=scene.blur_sigma_px,
        signal_electrons=1.0,
        reference_distance_mm=None,
    )
    spots = optics.stripes(points)
    electrons = per_sr[:, 0] * scene.solid_angle_sr(points)
    signal = stripe_images(
        spots.position_px.T, scene.spot_sigma_px()[None], electrons[None], PIXELS
    )
    background = background_scans([scene.background], PIXELS)
    array = DetectorArray(scene.detector, 1, PIXELS, background_electrons=background)
    counts = array.expose(
        np.broadcast_to(signal, (LINES, 1, PIXELS)), np.random.Generator(np.random.SFC64(seed))
    )
    assert counts.max() < scene.detector.full_scale
    level = background[0] / scene.detector.electrons_per_count + scene.detector.offset_counts
    lines = counts[:, 0] - level
    return lines[0], lines.mean(axis=0)


def test_a_target_is_as_wide_on_the_line_as_its_image() -> None:
    """A disc of 6 mm at 2 m, 25 mm behind the lens: 6 px of 12.5 um; its deviation is a quarter.

    Against the disc itself, its chords on a fine grid.
    """
    scene = scene_of_test_4_1()
    flat, spheres, active = (kind.source.width_mm for kind in scene.markers)
    assert (flat, spheres, active) == (6.0, 7.0, 0.4)
    x = (np.arange(10_000) + 0.5) / 5_000.0 - 1.0
    chord = np.sqrt(1.0 - x**2)
    deviation = np.sqrt((chord * x**2).sum() / chord.sum())
    sigma = scene.spot_sigma_px()
    for number, width_mm in ((0, flat), (22, spheres), (24, active)):
        image_px = width_mm * 25.0 / 2000.0 / 0.0125
        expected = np.hypot(scene.blur_sigma_px, deviation * image_px / 2.0)
        assert sigma[number] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("scene", "test"), [(scene_of_test_4_1(), "4.1"), (scene_of_test_4_2(), "4.2")]
)
def test_the_peaks_are_those_of_table_4_5(scene: TargetScene, test: str) -> None:
    _, mean = rendered(scene)
    # A fifth of the largest passive peak, the threshold of section 4.5.
    found, _ = find_peaks(mean, height=0.2 * np.delete(mean, np.s_[276:287]).max())
    assert len(found) == len(PEAK_MAXIMA_PX[test])
    np.testing.assert_allclose(found, PEAK_CENTROIDS_PX[test], atol=1.0)
    np.testing.assert_allclose(found, PEAK_MAXIMA_PX[test], atol=2.0)


def test_the_active_marker_is_several_times_as_bright_as_each_passive_target() -> None:
    """Section 4.3: the signal of a passive target is several times lower."""
    scene = scene_of_test_4_1()
    assert [len(kind.points_mm) for kind in scene.markers] == [22, 2, 1]
    _, per_sr = scene.photoelectrons_per_sr()
    assert per_sr[:24].max() < per_sr[24] / 3.0
    _, mean = rendered(scene)
    peak = [mean[round(centroid)] for centroid in PEAK_CENTROIDS_PX["4.1"]]
    assert int(np.argmax(peak)) == ACTIVE_PEAK
    assert np.delete(peak, ACTIVE_PEAK).max() < 0.5 * peak[ACTIVE_PEAK]


def test_the_two_close_peaks_of_test_4_2_are_not_separated_and_are_both_there() -> None:
    """Above a third of the maximum (section 4.2) they are one region; it has two maxima."""
    scene = scene_of_test_4_2()
    assert [len(kind.points_mm) for kind in scene.markers] == [22]
    line, mean = rendered(scene)
    for values in (line, mean):
        pair = values[95:120]
        above = np.flatnonzero(pair > pair.max() / 3.0)
        assert (np.diff(above) == 1).all()
        assert above[-1] - above[0] >= 7
    maxima, _ = find_peaks(mean[95:120], height=mean[95:120].max() / 2.0)
    assert len(maxima) == 2
    valley = mean[95 + maxima[0] : 96 + maxima[1]].min()
    assert 0.6 < valley / mean[95 + maxima].min() < 0.95


def test_the_background_of_test_4_2_is_brighter_than_its_peaks() -> None:
    """One threshold on the raw line finds the background instead: it has to be taken off."""
    scene = scene_of_test_4_2()
    line, _ = rendered(scene)
    raw = line + background_scans([scene.background], PIXELS)[0] / (60_000.0 / 255.0)
    weakest = min(raw[maximum] for maximum in PEAK_MAXIMA_PX["4.2"])
    dark = np.ones(PIXELS, dtype=bool)
    for maximum in PEAK_MAXIMA_PX["4.2"]:
        dark[maximum - 15 : maximum + 16] = False
    assert raw[dark].max() > weakest
    assert line[dark].max() < 0.3 * min(line[maximum] for maximum in PEAK_MAXIMA_PX["4.2"])
