"""PeakDetector: its definition pixel by pixel, its flags, and what it makes of any line."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.detection.matched_filter import gaussian_filter
from compute.signal.detection.peak_detector import DetectionSettings, PeakDetector
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.synthetic_scans import NOISE, gaussian_counts, measured, varied_lines

PIXELS = 200
MATCHED = gaussian_filter(2.0)


def detector(**options) -> PeakDetector:
    return PeakDetector(MATCHED, PIXELS, DetectionSettings(**options), NOISE)


def by_definition(line: NDArray[np.uint16], found: PeakDetector, noise: float) -> list[int]:
    """The places, straight from the definition, in Python's whole numbers."""
    rows = MATCHED.matrix(PIXELS).tolist()
    values = line.tolist()
    answer = [sum(t * v for t, v in zip(row, values, strict=True)) for row in rows]
    limit = min(int(found.threshold_scale * noise), 2**31 - 1)
    return [
        place
        for place in range(PIXELS)
        if answer[place] > limit
        and (place == 0 or answer[place] > answer[place - 1])
        and (place == PIXELS - 1 or answer[place] >= answer[place + 1])
    ]


@pytest.mark.parametrize("source", ["line", "model", "larger"])
def test_places_are_those_of_the_definition(source) -> None:
    lines = varied_lines(64, PIXELS, np.random.default_rng(1))
    found = detector(noise=source, max_peaks=100)
    batch = found.detect(lines)
    assert batch.count.sum() > 50
    for number, line in enumerate(lines):
        places = by_definition(line, found, float(batch.noise_counts[number]))
        assert batch.position_px[number, : batch.count[number]].tolist() == places


def test_a_peak_is_measured_in_counts_and_sigmas() -> None:
    rng = np.random.default_rng(2)
    mean = gaussian_counts(PIXELS, np.full(4000, 100.0), 2.0, 30.0)
    lines = measured(mean, rng)
    batch = detector(noise="model").detect(lines)
    at = np.flatnonzero((abs(batch.position_px - 100) <= 3).any(axis=1))
    assert len(at) > 0.999 * 4000
    first = (abs(batch.position_px - 100) <= 3).argmax(axis=1)
    amplitude = batch.amplitude[np.arange(4000), first][at]
    error = batch.noise_counts.mean() * MATCHED.norm / MATCHED.gain
    # The highest answer near the place is that at it, or a little more than that.
    standard = error / np.sqrt(4000)
    height = float(mean.max())
    assert height - 4.5 * standard < amplitude.mean() < height + 4.5 * standard + 0.05 * error
    sigma = batch.response_sigma[np.arange(4000), first][at]
    assert sigma.mean() == pytest.approx(amplitude.mean() / error, rel=0.01)


def test_peaks_at_the_very_ends_are_found_and_flagged_as_clipped() -> None:
    rng = np.random.default_rng(3)
    for place in (0.0, 2.0, 20.0, PIXELS - 3.0, PIXELS - 1.0):
        lines = measured(gaussian_counts(PIXELS, np.full(300, place), 2.0, 200.0), rng)
        batch = detector().detect(lines)
        clipped = (batch.flags & PeakFlag.CLIPPED) > 0
        near = (abs(batch.position_px - place) <= 1) & np.isfinite(batch.amplitude)
        assert near.any(axis=1).all()
        assert (clipped[near] == (place != 20.0)).all()


def test_bright_peaks_make_no_others() -> None:
    """A filter that is orthogonal to a constant answers below zero beside a peak, never above."""
    rng = np.random.default_rng(4)
    place = rng.uniform(0.0, PIXELS - 1.0, 4000)
    lines = measured(gaussian_counts(PIXELS, place, 2.0, 40000.0), rng)
    batch = detector(false_alarms_per_line=1e-4).detect(lines)
    assert (batch.count == 1).mean() > 0.999
    assert (abs(batch.position_px[:, 0] - place) < 1.0)[batch.count == 1].all()


def test_saturated_and_merged_peaks_are_flagged() -> None:
    rng = np.random.default_rng(5)
    apart = gaussian_counts(PIXELS, 60.0, 2.0, 500.0) + gaussian_counts(PIXELS, 130.0, 2.0, 9000.0)
    close = gaussian_counts(PIXELS, 60.0, 2.0, 500.0) + gaussian_counts(PIXELS, 72.0, 2.0, 400.0)
    lines = np.concatenate([measured(apart, rng, full=4095), measured(close, rng, full=4095)])
    batch = detector().detect(lines)
    assert batch.count.tolist() == [2, 2]
    assert batch.flags[0, :2].tolist() == [0, PeakFlag.SATURATED]
    assert batch.flags[1, :2].tolist() == [PeakFlag.MERGED, PeakFlag.MERGED]


def test_the_highest_are_kept_where_there_is_no_room() -> None:
    height = np.array([300.0, 100.0, 500.0, 200.0, 400.0])
    lines = measured(
        gaussian_counts(PIXELS, [20.0, 60.0, 100.0, 140.0, 180.0], 2.0, height).sum(
            axis=0, keepdims=True
        ),
        np.random.default_rng(6),
    )
    batch = detector(max_peaks=3).detect(lines)
    assert batch.count.tolist() == [3]
    assert batch.position_px[0].tolist() == [20, 100, 180]
    assert (batch.flags[0] & PeakFlag.TRUNCATED > 0).all()


def test_faint_peaks_that_single_pixels_do_not_show() -> None:
    """2.5 deviations of a pixel high: the filter finds what no pixel is 6 deviations above."""
    rng = np.random.default_rng(7)
    noise = np.sqrt(float(NOISE.dark_variance[0]) + 2.0)
    lines = measured(gaussian_counts(PIXELS, np.full(2000, 90.0), 2.0, 2.5 * noise), rng)
    batch = detector(noise="model", false_alarms_per_line=0.1).detect(lines)
    found = (abs(batch.position_px - 90) <= 3).any(axis=1).mean()
    single = (lines[:, 84:97] >= 120.0 + 6.0 * noise).any(axis=1).mean()
    assert found > 0.7
    assert single < 0.01


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    lines=arrays(
        np.uint16,
        st.tuples(st.integers(0, 2), st.just(PIXELS)),
        elements=st.sampled_from([0, 1, 2, 100, 4094, 4095, 65535]) | st.integers(0, 65535),
    ),
    source=st.sampled_from(["line", "model", "larger"]),
)
def test_any_line_gives_defined_results(lines: np.ndarray, source) -> None:
    batch = detector(noise=source, max_peaks=4).detect(lines)
    assert len(batch) == len(lines)
    for number, count in enumerate(batch.count):
        assert 0 <= count <= 4
        places = batch.position_px[number, :count]
        assert (np.diff(places) > 0).all()
        assert ((places >= 0) & (places < PIXELS)).all()
        for values in (batch.response_sigma, batch.amplitude):
            assert np.isfinite(values[number, :count]).all()
            assert (values[number, :count] > 0.0).all()
            assert np.isnan(values[number, count:]).all()
        assert (batch.position_px[number, count:] == -1).all()
        assert not batch.flags[number, count:].any()


@pytest.mark.parametrize("level", [0, 4095, 65535])
def test_constant_lines_hold_nothing(level: int) -> None:
    assert detector().detect(np.full((2, PIXELS), level, np.uint16)).count.sum() == 0


def test_a_line_belongs_to_its_sensor() -> None:
    noise = SensorNoise.of(1.0, [1.0, 1000.0], 0.0, [200, 65535])
    lines = np.tile(np.rint(gaussian_counts(PIXELS, 90.0, 2.0, 300.0)), (4, 1)).astype(np.uint16)
    batch = PeakDetector(MATCHED, PIXELS, DetectionSettings(noise="model"), noise).detect(lines)
    assert batch.count.tolist() == [1, 0, 1, 0]
    assert batch.flags[0, 0] == PeakFlag.SATURATED


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: DetectionSettings(0.0), "false_alarms_per_line is 0.0"),
        (lambda: DetectionSettings(float("nan")), "false_alarms_per_line is nan"),
        (lambda: DetectionSettings(noise="both"), "noise is 'both'"),
        (lambda: DetectionSettings(max_peaks=0), "max_peaks is 0"),
        (lambda: PeakDetector(MATCHED, 32, DetectionSettings(), NOISE), "32 pixels"),
        (lambda: PeakDetector(gaussian_filter(9.0), 64, DetectionSettings(), NOISE), "145 or"),
        (lambda: detector().detect(np.zeros((1, 64), np.uint16)), r"\(1, 64\)"),
        (lambda: detector().detect(np.zeros((1, PIXELS))), "float64"),
    ],
)
def test_what_is_refused(make, match: str) -> None:
    with pytest.raises(InvalidParameter, match=match):
        make()
