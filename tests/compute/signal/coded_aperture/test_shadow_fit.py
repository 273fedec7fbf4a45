"""ShadowFitter and MaskReader: what is found and flagged; any line gives defined figures."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.stats import poisson

from compute.errors import InvalidParameter
from compute.signal.coded_aperture.shadow_fit import MaskReader, ShadowFitter, ShadowSettings
from compute.signal.coded_aperture.shadow_search import ShadowSearch
from compute.signal.coded_aperture.shadow_template import ShadowTemplate
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise

PIXELS = 256
NOISE = SensorNoise.of(10.0, 20.0, 100.0, 4095)
CODE = np.array([1, 1, 1, 0, 0, 1, 0, 1, 1, 0, 0, 0, 1, 0, 1])


def smooth_bars(code: np.ndarray, per_px: int = 4, bar_px: int = 8) -> np.ndarray:
    """Bars with soft edges, dark at both ends."""
    cells = np.repeat(np.concatenate([[0, 0], code, [0, 0]]), bar_px * per_px).astype(float)
    soft = np.hanning(3 * per_px + 1)
    return np.convolve(cells, soft / soft.sum(), "same")


TEMPLATE = ShadowTemplate(smooth_bars(CODE), 4, 40, 100.0, dark_beyond=True)


def measured(
    shift: NDArray[np.float64], height: float, rng: np.random.Generator, full: int = 65535
) -> NDArray[np.uint16]:
    light = TEMPLATE.at(np.arange(float(PIXELS)) - np.asarray(shift)[:, None])[0]
    electrons = 10.0 * (height * light + 30.0)
    noisy = rng.poisson(electrons) + rng.normal(0.0, 20.0, electrons.shape)
    return np.rint(noisy / 10.0 + 100.0).clip(0, full).astype(np.uint16)


def test_shift_brightness_and_ambient_level_are_found() -> None:
    rng = np.random.default_rng(1)
    shift = rng.uniform(-35.0, 60.0, 3000)
    fit = ShadowFitter(TEMPLATE, PIXELS, NOISE).fit(measured(shift, 200.0, rng))
    assert fit.found.all()
    assert not fit.flags.any()
    error = (fit.shift_px - shift) / fit.sigma_px
    # 5 standard errors of 3,000 draws.
    assert np.mean(error**2) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 3000))
    assert abs(error.mean()) < 5 / np.sqrt(3000)
    # About 100 lit pixels of 4.6 counts of noise know the brightness to 0.6 counts.
    assert fit.amplitude.mean() == pytest.approx(200.0, abs=5 * 0.8 / np.sqrt(3000))
    assert fit.ambient.mean() == pytest.approx(130.0, abs=5 * 0.5 / np.sqrt(3000))
    assert (fit.scale == 1.0).all()


def test_the_search_compares_shifts_fairly() -> None:
    """What it maximises is by how much the pattern there lowers the sum of squares."""
    rng = np.random.default_rng(2)
    line = rng.normal(100.0, 5.0, PIXELS)
    search = ShadowSearch(TEMPLATE, PIXELS)
    found = search.find(line[None])
    pixel = np.arange(float(PIXELS))
    gains = []
    for shift in range(search.lowest_px, search.highest_px + 1):
        value = TEMPLATE.at(pixel - shift)[0]
        columns = np.stack([value, np.ones(PIXELS)], axis=1)
        solved, (rest,), _, _ = np.linalg.lstsq(columns, line, rcond=None)
        gains.append((PIXELS * line.var() - rest) * np.sign(solved[0]))
    assert found.height[0] ** 2 == pytest.approx(max(gains), rel=1e-6)
    best = search.lowest_px + int(np.argmax(gains))
    assert abs(found.shift_px[0] - best) <= 1.0
    beside = [g for k, g in enumerate(gains) if abs(k - np.argmax(gains)) > search.lobe_px]
    assert found.second_height[0] ** 2 == pytest.approx(max(beside), rel=1e-6)
    assert search.share(np.array([0.0])) == pytest.approx(1.0, abs=0.01)
    assert search.share(np.array([search.lowest_px - 10.0])) <= 0.11


@pytest.mark.parametrize("rate", [0.5, 0.05])
def test_empty_lines_give_no_more_readings_than_chosen(rate: float) -> None:
    rng = np.random.default_rng(3)
    lines = 6000
    fitter = ShadowFitter(TEMPLATE, PIXELS, NOISE, ShadowSettings(false_alarms_per_line=rate))
    found = int(fitter.fit(measured(np.full(lines, 1e5), 0.0, rng)).found.sum())
    # Fewer: neighbouring shifts are alike, and one line gives one reading.
    assert 0 < found <= poisson.isf(1e-5, rate * lines)


def test_faint_shadows_are_found_right_or_flagged_or_not_found() -> None:
    """Prints the share of shadows found by their brightness against a pixel's noise."""
    rng = np.random.default_rng(4)
    shift = rng.uniform(-30.0, 60.0, 1000)
    fitter = ShadowFitter(TEMPLATE, PIXELS, NOISE)
    for height, least in ((1.0, 0.0), (2.0, 0.2), (4.0, 0.999)):
        fit = fitter.fit(measured(shift, height, rng))
        wrong = fit.found & ~(abs(fit.shift_px - shift) < 20.0)
        unsaid = wrong & (fit.flags & int(PeakFlag.AMBIGUOUS) == 0)
        print(
            f"{height} counts over noise of 2.7: found {fit.found.mean():.3f}, in a side lobe "
            f"{wrong.mean():.3f}, without a flag {unsaid.mean():.3f}"
        )
        assert fit.found.mean() >= least
        # One in 10,000 by the settings.
        assert unsaid.sum() <= poisson.isf(1e-5, 1e-4 * 1000)


def test_a_pattern_that_repeats_is_ambiguous() -> None:
    period = np.tile([1, 0, 1, 1, 0], 6)
    template = ShadowTemplate(smooth_bars(period, bar_px=4), 4, 60, 100.0, dark_beyond=True)
    rng = np.random.default_rng(5)
    value = template.at(np.arange(float(PIXELS)))[0]

    def flags_at(height: float) -> NDArray[np.int32]:
        electrons = np.tile(10.0 * (height * value + 30.0), (200, 1))
        noisy = rng.poisson(electrons) + rng.normal(0.0, 20.0, electrons.shape)
        fit = ShadowFitter(template, PIXELS, NOISE).fit(
            np.rint(noisy / 10.0 + 100.0).astype(np.uint16)
        )
        return fit.flags[fit.found] & int(PeakFlag.AMBIGUOUS)

    # 6 periods against 5: faint, another shift is as good; bright, the sixth decides.
    assert (flags_at(2.0) > 0).mean() > 0.9
    assert (flags_at(100.0) == 0).all()


def test_a_pattern_half_off_the_line_is_clipped_and_read_all_the_same() -> None:
    rng = np.random.default_rng(6)
    fitter = ShadowFitter(TEMPLATE, PIXELS, NOISE)
    for shift, clipped in ((0.0, False), (60.0, False), (130.0, True), (-110.0, True)):
        where = shift + rng.uniform(-0.5, 0.5, 400)
        fit = fitter.fit(measured(where, 400.0, rng))
        assert fit.found.all()
        assert ((fit.flags & PeakFlag.CLIPPED > 0) == clipped).all()
        error = (fit.shift_px - where) / fit.sigma_px
        assert np.mean(error**2) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 400))


def test_saturated_pixels_are_left_out() -> None:
    rng = np.random.default_rng(7)
    shift = rng.uniform(-5.0, 5.0, 400)
    lines = measured(shift, 6000.0, rng, full=4095)
    fit = ShadowFitter(TEMPLATE, PIXELS, NOISE).fit(lines)
    assert fit.found.all()
    assert (fit.flags & PeakFlag.SATURATED > 0).all()
    # The slopes of the bars are left; with the flat tops it would be 4,000 counts.
    assert fit.amplitude.mean() == pytest.approx(6000.0, rel=0.03)
    assert abs(fit.shift_px - shift).max() < 0.05
    dim = ShadowFitter(TEMPLATE, PIXELS, NOISE).fit(measured(shift, 2000.0, rng, full=4095))
    assert not (dim.flags & PeakFlag.SATURATED).any()


def test_as_many_pixels_as_parameters_hold_no_shadow() -> None:
    lines = np.full((1, PIXELS), 4095, np.uint16)
    lines[0, [44, 166, 207]] = [2426, 2917, 3882]
    eager = ShadowSettings(false_alarms_per_line=0.99)
    assert not ShadowFitter(TEMPLATE, PIXELS, NOISE, eager).fit(lines).found.any()


def test_another_pattern_fits_poorly() -> None:
    rng = np.random.default_rng(8)
    other = ShadowTemplate(smooth_bars(CODE[::-1]), 4, 40, 100.0, dark_beyond=True)
    lines = measured(np.zeros(100), 400.0, rng)
    fit = ShadowFitter(other, PIXELS, NOISE).fit(lines)
    assert (fit.flags[fit.found] & PeakFlag.POOR_FIT > 0).all()
    assert (fit.reduced_chi2[fit.found] > 100.0).all()


def test_a_magnified_shadow_needs_the_scale() -> None:
    rng = np.random.default_rng(9)
    pixel = np.arange(float(PIXELS))
    scale, shift = 1.01, 3.3
    reading = TEMPLATE.reading_px
    light = TEMPLATE.at(reading + (pixel - reading - shift) / scale)[0]
    noisy = rng.poisson(np.tile(10.0 * (300.0 * light + 30.0), (400, 1))) / 10.0 + 100.0
    lines = np.rint(noisy).astype(np.uint16)
    noise = SensorNoise.of(10.0, 0.0, 100.0)
    fixed = ShadowFitter(TEMPLATE, PIXELS, noise).fit(lines)
    free = ShadowFitter(TEMPLATE, PIXELS, noise, ShadowSettings(fit_scale=True)).fit(lines)
    assert free.scale.mean() == pytest.approx(scale, abs=1e-4)
    error = (free.shift_px - shift) / free.sigma_px
    assert np.mean(error**2) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 400))
    assert abs(fixed.shift_px.mean() - shift) > 5.0 * abs(free.shift_px.mean() - shift)
    assert (fixed.flags & PeakFlag.POOR_FIT > 0).all()
    assert not free.flags.any()


def test_beyond_an_unknown_end_pixels_are_left_out() -> None:
    """A template of the line alone, of a pattern that is longer: shifted, less is compared."""
    rng = np.random.default_rng(10)
    long = ShadowTemplate(smooth_bars(rng.integers(0, 2, 60)), 4, -128, 100.0, dark_beyond=True)
    part = ShadowTemplate(
        long.cells[4 * 128 : 4 * (128 + PIXELS)].copy(), 4, 0, 100.0, dark_beyond=False
    )
    pixel = np.arange(float(PIXELS))
    shift = rng.uniform(-40.0, 40.0, 400)
    electrons = 10.0 * (200.0 * long.at(pixel - shift[:, None])[0] + 30.0)
    lines = np.rint(
        (rng.poisson(electrons) + rng.normal(0.0, 20.0, electrons.shape)) / 10.0 + 100.0
    ).astype(np.uint16)
    fit = ShadowFitter(part, PIXELS, NOISE).fit(lines)
    assert fit.found.all()
    error = (fit.shift_px - shift) / fit.sigma_px
    # The cut spline differs from the long one in its last cells.
    assert np.mean(error**2) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 400) + 0.05)
    assert fit.reduced_chi2.mean() == pytest.approx(1.0, abs=0.02)


def test_readings_of_several_sensors_in_turn() -> None:
    rng = np.random.default_rng(11)
    other = ShadowTemplate(smooth_bars(CODE[::-1]), 4, 40, 90.0, dark_beyond=True)
    shift = np.array([2.2, -7.7])
    lines = np.empty((6, PIXELS), np.uint16)
    lines[0::3] = measured(shift, 300.0, rng)
    light = other.at(np.arange(float(PIXELS)) - shift[:, None])[0]
    lines[1::3] = np.rint(300.0 * light + 130.0)
    lines[2::3] = 130
    reader = MaskReader([TEMPLATE, other, TEMPLATE], PIXELS, NOISE)
    batch = reader.read(lines)
    assert batch.count.tolist() == [1, 1, 0, 1, 1, 0]
    np.testing.assert_allclose(batch.position_px[0::3, 0], 100.0 + shift, atol=0.05)
    np.testing.assert_allclose(batch.position_px[1::3, 0], 90.0 + shift, atol=0.01)
    assert np.isnan(batch.position_px[2::3]).all()
    assert not batch.flags.any()
    assert batch.width_px[0, 0] == pytest.approx(8 * 15, abs=1.0)
    assert (batch.sigma_px[batch.count == 1] > 0.0).all()
    assert batch.peaks(2) == ()
    assert batch.peaks(0)[0].flags == ()


@settings(max_examples=60, deadline=None)
@given(
    lines=arrays(
        np.uint16,
        st.tuples(st.integers(0, 3), st.just(PIXELS)),
        elements=st.sampled_from([0, 100, 101, 4094, 4095, 65535]) | st.integers(0, 65535),
    ),
    scale=st.booleans(),
)
def test_any_line_gives_defined_readings(lines: NDArray[np.uint16], scale: bool) -> None:
    eager = ShadowSettings(fit_scale=scale, false_alarms_per_line=0.99)
    batch = MaskReader([TEMPLATE], PIXELS, NOISE, eager).read(lines)
    assert len(batch) == len(lines)
    for number, count in enumerate(batch.count):
        figures = [
            float(values[number, 0])
            for values in (batch.position_px, batch.sigma_px, batch.amplitude, batch.width_px)
        ]
        if count:
            assert np.isfinite(figures).all()
            assert min(figures[1:]) > 0.0
        else:
            assert np.isnan(figures).all()
            assert batch.flags[number, 0] == 0


@pytest.mark.parametrize("level", [0, 100, 4095, 65535])
def test_even_lines_hold_no_shadow(level: int) -> None:
    assert (
        not ShadowFitter(TEMPLATE, PIXELS, NOISE)
        .fit(np.full((2, PIXELS), level, np.uint16))
        .found.any()
    )


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: ShadowSettings(false_alarms_per_line=0.0), "false_alarms_per_line is 0.0"),
        (lambda: ShadowSettings(ambiguity_probability=1.0), "ambiguity_probability is 1.0"),
        (lambda: ShadowSettings(misfit_probability=float("nan")), "misfit_probability is nan"),
        (lambda: ShadowFitter(TEMPLATE, 4, NOISE), "4 pixels"),
        (
            lambda: ShadowFitter(TEMPLATE, PIXELS, NOISE).fit(np.zeros((1, 9), np.uint16)),
            r"\(1, 9\)",
        ),
        (lambda: ShadowFitter(TEMPLATE, PIXELS, NOISE).fit(np.zeros((1, PIXELS))), "float64"),
        (
            lambda: MaskReader([TEMPLATE] * 2, PIXELS, SensorNoise.of([1.0] * 3, 1.0)),
            "2 templates and the noise of 3 sensors",
        ),
        (lambda: MaskReader([], PIXELS, NOISE), "0 templates"),
    ],
)
def test_what_is_refused(make, match: str) -> None:
    with pytest.raises(InvalidParameter, match=match):
        make()
