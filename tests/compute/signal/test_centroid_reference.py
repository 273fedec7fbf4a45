"""What counts as a peak, where it is, and what its flags say: by lines with known answers."""

import numpy as np
import pytest

from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.peaks import PeakFlag
from tests.compute.signal.synthetic_scans import FULL, NOISE, gaussian_counts, measured


@pytest.fixture(params=["kernel", "reference"])
def find(request):
    def by_kernel(lines, options=None):
        lines = np.atleast_2d(lines)
        options = options or CentroidSettings()
        return CentroidFinder(len(lines), lines.shape[1], options, NOISE, "cpu").find(lines)

    def by_reference(lines, options=None):
        return find_peaks_reference(np.atleast_2d(lines), options or CentroidSettings(), NOISE)

    return by_kernel if request.param == "kernel" else by_reference


def line_of(*peaks, pixels=1024, seed=0):
    """Return a noisy line with peaks (position, width, height) over ambient light."""
    counts = gaussian_counts(pixels, *zip(*peaks, strict=True)).sum(axis=0, keepdims=True)
    return measured(counts, np.random.default_rng(seed), full=FULL)


def test_centre_of_gravity_by_hand(find):
    # Background 100; maximum 100 + 90, threshold 100 + 30 at a third.
    line = np.full(128, 100, np.uint16)
    line[50:55] = 110, 150, 190, 160, 120
    # 110 and 120 are below 130: the run is 150, 190, 160 at 51, 52, 53.
    third = 21845 / 65536  # a third, as it is used
    cut = 100 + np.floor(90 * 64 * third) / 64
    weighed = find(line, CentroidSettings(weighting="above-background"))
    assert weighed.position_px[0, 0] == pytest.approx((51 * 50 + 52 * 90 + 53 * 60) / 200)
    weighed = find(line, CentroidSettings(weighting="above-threshold"))
    weights = np.array([150, 190, 160]) - cut
    assert weighed.position_px[0, 0] == pytest.approx(
        (weights * [51, 52, 53]).sum() / weights.sum()
    )
    assert weighed.amplitude[0, 0] == 90
    # The crossings lie 20/40 of a pixel left of 51 and 30/40 right of 53.
    assert weighed.width_px[0, 0] == pytest.approx(2 + 0.5 + 0.75, abs=1e-3)
    assert weighed.count.tolist() == [1]
    assert weighed.flags[0, 0] == PeakFlag.NONE
    assert np.isnan(weighed.position_px[0, 1:]).all()
    assert not weighed.flags[0, 1:].any()


def test_a_symmetric_peak_is_at_its_middle(find):
    line = np.full(128, 100, np.uint16)
    line[50:55] = 120, 150, 190, 150, 120
    for weighting in ("edge-corrected", "above-threshold", "above-background"):
        found = find(line, CentroidSettings(weighting=weighting))
        assert found.position_px[0, 0] == pytest.approx(52, abs=1e-12)


def test_each_peak_is_cut_at_a_third_of_its_own_maximum(find):
    # 1 : 10, and ten widths apart.
    found = find(line_of((400.3, 2.0, 3000.0), (420.7, 2.0, 300.0)))
    assert found.count.tolist() == [2]
    np.testing.assert_allclose(found.position_px[0, :2], [400.3, 420.7], atol=0.15)
    np.testing.assert_allclose(found.amplitude[0, :2], [3000, 300], rtol=0.1)
    np.testing.assert_allclose(found.width_px[0, :2], [5.93, 5.93], rtol=0.1)
    assert not found.flags.any()


def test_peaks_are_in_the_order_of_their_positions(find):
    places = [30.0, 200.5, 500.25, 700.0, 990.75]
    found = find(line_of(*((place, 2.0, 2000.0 - place) for place in places)))
    np.testing.assert_allclose(found.position_px[0, :5], places, atol=0.1)


@pytest.mark.parametrize("level", [0, 100, 4095, 65535])
def test_a_flat_line_has_no_peaks(find, level):
    assert find(np.full(2048, level, np.uint16)).count.tolist() == [0]


def test_ambient_light_that_varies_along_the_line_makes_no_peaks(find):
    slope = np.linspace(0.0, 500.0, 1024)
    hill = 400.0 * np.sin(np.linspace(0.0, np.pi, 1024))
    lines = measured(np.stack([slope, slope[::-1], hill]), np.random.default_rng(1))
    assert find(lines).count.tolist() == [0, 0, 0]
    with_peak = lines + np.rint(gaussian_counts(1024, 300.0, 2.0, 3000.0)).astype(np.uint16)
    assert find(with_peak).count.tolist() == [1, 1, 1]


def test_a_hot_pixel_is_no_peak(find):
    line = line_of((300.0, 2.0, 500.0))
    line[0, 700] = 2000
    assert find(line).count.tolist() == [1]
    assert find(line, CentroidSettings(min_width_px=1)).count.tolist() == [2]


def test_many_peaks_do_not_raise_the_background(find):
    # Twenty-two targets on 512 pixels, as on the thesis's rectangular camera (Test 4.2).
    places = 15.0 + 22.5 * np.arange(22)
    line = line_of(*((place, 1.5, 400.0) for place in places), pixels=512)
    found = find(line, CentroidSettings(max_peaks=32))
    assert found.count.tolist() == [22]
    np.testing.assert_allclose(found.position_px[0, :22], places, atol=0.15)
    np.testing.assert_allclose(found.amplitude[0, :22], 400.0, rtol=0.15)


def test_saturated(find):
    found = find(line_of((200.4, 3.0, 9000.0), (500.0, 3.0, 3000.0)))
    assert found.flags[0, :2].tolist() == [PeakFlag.SATURATED, PeakFlag.NONE]
    assert found.position_px[0, 0] == pytest.approx(200.4, abs=0.05)


def test_clipped_at_either_end(find):
    found = find(line_of((0.5, 2.0, 1000.0), (100.0, 2.0, 1000.0), (1023.0, 2.0, 1000.0)))
    assert found.flags[0, :3].tolist() == [PeakFlag.CLIPPED, PeakFlag.NONE, PeakFlag.CLIPPED]


@pytest.mark.parametrize("side", [1, -1])
def test_merged_says_that_two_maxima_share_a_run(find, side):
    # A valley of two thirds: above the threshold of both.
    pair = find(line_of((500.0, 2.0, 1000.0), (500.0 + side * 6.2, 2.0, 900.0)))
    assert pair.count.tolist() == [1]
    assert pair.flags[0, 0] == PeakFlag.MERGED
    # Without a valley nothing can be told.
    shoulder = find(line_of((500.0, 2.0, 1000.0), (500.0 + side * 3.0, 2.0, 900.0)))
    assert shoulder.flags[0, 0] == PeakFlag.NONE


def test_noise_on_a_wide_top_is_not_taken_for_a_valley(find):
    rng = np.random.default_rng(2)
    lines = measured(gaussian_counts(512, np.full(200, 256.0), 30.0, 2000.0), rng)
    found = find(lines)
    assert (found.count == 1).all()
    assert not found.flags.any()


def test_truncated_keeps_the_brightest(find):
    heights = [500.0, 900.0, 300.0, 1200.0, 700.0]
    line = line_of(*((100.0 * (k + 1), 2.0, height) for k, height in enumerate(heights)))
    found = find(line, CentroidSettings(max_peaks=3))
    assert found.count.tolist() == [3]
    np.testing.assert_allclose(found.position_px[0], [200, 400, 500], atol=0.2)
    assert (found.flags[0] == PeakFlag.TRUNCATED).all()
    exactly = find(line, CentroidSettings(max_peaks=5))
    assert not exactly.flags.any()


def test_positions_far_along_a_line_are_as_precise(find):
    near = np.rint(gaussian_counts(16384, 200.37, 2.0, 2000.0) + 100).astype(np.uint16)
    far = np.roll(near, 16000, axis=1)
    shift = find(far).position_px[0, 0] - find(near).position_px[0, 0]
    assert shift == pytest.approx(16000, abs=1e-9)
