"""The kernel on the CPU against the reference, and the finder's own behaviour."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from compute.errors import InvalidParameter
from compute.signal import centroid_finder, peak_finder
from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.peak_finder import check_capacity
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.synthetic_scans import (
    FULL,
    GAIN,
    NOISE,
    OFFSET,
    assert_same,
    gaussian_counts,
    measured,
    varied_lines,
)

WEIGHTINGS = ["edge-corrected", "above-threshold", "above-background"]

centroid_settings = st.builds(
    CentroidSettings,
    threshold_fraction=st.sampled_from([1 / 3, 0.05, 0.2, 0.5, 0.95]),
    detection_sigma=st.sampled_from([3.0, 6.0, 20.0]),
    min_width_px=st.integers(1, 4),
    weighting=st.sampled_from(WEIGHTINGS),
    max_peaks=st.integers(1, 20),
)
line_noise = st.builds(
    SensorNoise.of,
    electrons_per_count=st.floats(0.1, 100.0),
    read_noise_electrons=st.floats(0.0, 100.0),
    offset_counts=st.floats(-100.0, 2000.0),
    full_scale_counts=st.sampled_from([255, 4095, 65535]),
)


def check(lines, options, noise):
    centroid_finder = CentroidFinder(len(lines), lines.shape[1], options, noise, "cpu")
    assert_same(centroid_finder.find(lines), find_peaks_reference(lines, options, noise))


@pytest.mark.slow
@given(st.integers(64, 4096), st.integers(0, 2**32), centroid_settings, line_noise)
@example(64, 0, CentroidSettings(), NOISE)
@example(127, 1, CentroidSettings(), NOISE)
@example(4095, 2, CentroidSettings(max_peaks=3), NOISE)
def test_kernel_matches_reference_on_lines_with_peaks(pixels, seed, options, noise):
    check(varied_lines(8, pixels, np.random.default_rng(seed)), options, noise)


@given(
    st.one_of(
        arrays(np.uint16, st.tuples(st.just(2), st.integers(64, 200))),
        arrays(
            np.uint16,
            st.tuples(st.just(2), st.integers(64, 200)),
            elements=st.sampled_from([0, 1, 100, 101, 130, 300, 4095, 65534, 65535]),
            fill=st.sampled_from([0, 100, 65535]),
        ),
    ),
    centroid_settings,
    line_noise,
)
def test_kernel_matches_reference_on_any_counts(lines, options, noise):
    check(lines, options, noise)


@pytest.mark.slow
@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("pixels", [64, 2048, 4097])
def test_kernel_matches_reference_on_many_lines(pixels, weighting):
    lines = varied_lines(64, pixels, np.random.default_rng(pixels))
    options = CentroidSettings(weighting=weighting, max_peaks=5)
    expected = find_peaks_reference(lines, options, NOISE)
    assert expected.count.max() == 5
    check(lines, options, NOISE)


def test_a_batch_smaller_than_the_room_leaves_nothing_behind():
    rng = np.random.default_rng(5)
    lines = varied_lines(24, 512, rng)
    options = CentroidSettings(max_peaks=4)
    centroid_finder = CentroidFinder(24, 512, options, NOISE, "cpu")
    first = centroid_finder.find(lines)
    for count in (7, 24, 1, 0, 24):
        found = centroid_finder.find(lines[:count])
        assert len(found) == count
        assert_same(found, find_peaks_reference(lines[:count], options, NOISE))
    # Only the lines given are read and their records written.
    other = np.ascontiguousarray(lines[::-1])
    centroid_finder.find(other[:7])
    np.testing.assert_array_equal(centroid_finder.download(24).count[7:], first.count[7:])
    # What was returned is the caller's: later calls do not write to it.
    centroid_finder.find(other)
    assert_same(first, find_peaks_reference(lines, options, NOISE))


def test_lines_take_the_noise_of_their_sensor_in_turn():
    lines = measured(gaussian_counts(256, 100.3, 2.0, 60.0), np.random.default_rng(6))
    noise = SensorNoise.of([10.0, 10.0, 0.1], [20.0, 1000.0, 20.0], 100.0)
    centroid_finder = CentroidFinder(6, 256, CentroidSettings(), noise, "cpu")
    found = centroid_finder.find(np.repeat(lines, 6, axis=0))
    assert found.count.tolist() == [1, 0, 0, 1, 0, 0]


def test_lines_may_be_views_with_gaps():
    lines = varied_lines(16, 600, np.random.default_rng(7))
    centroid_finder = CentroidFinder(16, 300, CentroidSettings(), NOISE, "cpu")
    for view in (lines[::2, ::2], lines[:, 300:]):
        expected = find_peaks_reference(np.ascontiguousarray(view), CentroidSettings(), NOISE)
        assert expected.count.sum() > 0
        assert_same(centroid_finder.find(view), expected)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (np.zeros((2, 256), np.int16), "int16"),
        (np.zeros((2, 256), ">u2"), ">u2"),
        (np.zeros(256, np.uint16), r"\(256,\)"),
        (np.zeros((2, 255), np.uint16), r"\(2, 255\)"),
        (np.zeros((5, 256), np.uint16), r"\(5, 256\).*at most 4"),
    ],
)
def test_wrong_lines_are_refused_with_the_reason(lines, words):
    centroid_finder = CentroidFinder(4, 256, CentroidSettings(), NOISE, "cpu")
    with pytest.raises(InvalidParameter, match=words):
        centroid_finder.find(lines)


@pytest.mark.parametrize("count", [0, 3])
def test_no_more_lines_are_read_than_were_given(count):
    centroid_finder = CentroidFinder(4, 256, CentroidSettings(), NOISE, "cpu")
    with pytest.raises(InvalidParameter, match=r"count is 1.*the scans uploaded"):
        centroid_finder.launch(1)
    centroid_finder.upload(np.zeros((2, 256), np.uint16))
    with pytest.raises(InvalidParameter, match=rf"count is {count}; it must be 1 \.\. 2"):
        centroid_finder.launch(count)


@pytest.mark.parametrize(
    ("lines", "pixels", "device", "words"),
    [
        (0, 256, "cpu", "scans is 0"),
        (4, 63, "cpu", "63 pixels"),
        (4, 65537, "cpu", "65537 pixels"),
        (4, 256, "cuda:99", "'cuda:99'"),
        (4, 256, "abacus", "'abacus'.*cpu"),
    ],
)
def test_a_finder_that_cannot_be_is_refused_with_the_reason(lines, pixels, device, words):
    with pytest.raises(InvalidParameter, match=words):
        CentroidFinder(lines, pixels, CentroidSettings(), NOISE, device)


def test_more_than_an_array_holds_is_refused_with_what_it_would_hold():
    """In Warp's words it would be a ValueError that says nothing of lines."""
    with pytest.raises(InvalidParameter, match="scans is 2147483647, of 128 pixels each"):
        CentroidFinder(2**31 - 1, 128, CentroidSettings(), NOISE, "cpu")
    for pixels, words, copied, most in (
        (2048, 40, True, 2**20 - 1),
        (2048, 40, False, 53_687_091),
        (64, 130, True, 16_519_104),
    ):
        check_capacity(most, pixels, words, copied=copied)
        with pytest.raises(InvalidParameter, match=f"takes {most} such scans"):
            check_capacity(most + 1, pixels, words, copied=copied)


@pytest.mark.parametrize("sensors", [1, 3, 4])
@pytest.mark.parametrize("threads", [2, 3, 7])
def test_threads_share_a_batch_and_change_nothing(threads, sensors, monkeypatch):
    monkeypatch.setattr(peak_finder, "HEAD_START_PIXELS", 50_000)
    monkeypatch.setattr(centroid_finder, "PIXELS_PER_THREAD", 100_000)
    # Noise by sensor: a part that began with another sensor than 0 would find other peaks.
    noise = SensorNoise.of(GAIN, np.linspace(5.0, 200.0, sensors), OFFSET, FULL)
    lines = np.tile(varied_lines(120, 512, np.random.default_rng(3)), (17, 1))
    assert lines.size > 50_000 + threads * 100_000
    options = CentroidSettings(max_peaks=3)
    one = CentroidFinder(len(lines), 512, options, noise, "cpu", threads=1)
    more = CentroidFinder(len(lines), 512, options, noise, "cpu", threads=threads)
    # Other sizes in between: what was prepared for one must not serve another.
    for count in (len(lines), 1, 1000, len(lines)):
        expected, found = one.find(lines[:count]), more.find(lines[:count])
        for name, values in vars(expected).items():
            np.testing.assert_array_equal(getattr(found, name), values, name)


def test_a_batch_needs_a_thread():
    for threads in (0, -1):
        with pytest.raises(InvalidParameter, match=f"threads is {threads}"):
            CentroidFinder(10, 128, CentroidSettings(), NOISE, "cpu", threads=threads)


def test_a_batch_outlives_the_next():
    lines = varied_lines(40, 256, np.random.default_rng(4))
    centroid_finder = CentroidFinder(20, 256, CentroidSettings(), NOISE, "cpu")
    first = centroid_finder.find(lines[:20])
    kept = {name: values.copy() for name, values in vars(first).items()}
    centroid_finder.find(lines[20:])
    for name, values in kept.items():
        np.testing.assert_array_equal(getattr(first, name), values, name)
    with pytest.raises(ValueError, match="read-only"):
        first.reduced_chi2[:] = 0.0
