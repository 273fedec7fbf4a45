"""A device's pixels: photon transfer, fixed patterns, background, blooming, reproducibility."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.detector import Detector
from compute.optics.detector_array import DetectorArray

Array = NDArray[np.float64]
IDEAL = Detector(12, 12.0, 64.0, 30.0, 45_000.0, 400.0)
REAL = replace(
    IDEAL,
    dark_electrons=150.0,
    response_nonuniformity=0.02,
    dark_nonuniformity=0.4,
    offset_nonuniformity_counts=1.5,
)
S, P = 4, 2048


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(seed))


def exposures(array: DetectorArray, signal: Array, number: int, seed: int = 3) -> Array:
    rng = generator(seed)
    many = np.broadcast_to(signal, (number, *signal.shape))
    return array.expose(many, rng).astype(np.float64)


def even(level: float) -> Array:
    return np.full((S, P), level)


def test_without_differences_it_counts_what_the_detector_counts() -> None:
    signal = np.zeros((3, S, P))
    signal[:, :, 300:340] = 900.0
    array = DetectorArray(IDEAL, S, P, pattern_seed=5)
    np.testing.assert_array_equal(
        array.expose(signal, generator(1)), IDEAL.expose(signal, generator(1))
    )


@pytest.mark.parametrize("signal", [0.0, 3000.0])
def test_every_pixel_has_its_own_mean_and_variance(signal: float) -> None:
    background = np.tile(np.linspace(0.0, 3000.0, P), (S, 1))
    array = DetectorArray(REAL, S, P, pattern_seed=9, background_electrons=background)
    number = 400
    counts = exposures(array, even(signal), number)
    pattern = array.pattern
    electrons = (signal + 400.0 + background) * pattern.response + pattern.dark_electrons
    variance = (electrons + 30.0**2) / 12.0**2 + 1.0 / 12.0
    due = electrons / 12.0 + pattern.offset_counts
    deviation = (counts.mean(axis=0) - due) / np.sqrt(variance / number)
    # 8192 independent, nearly normal deviations: their mean square has the deviation sqrt(2/n).
    assert (deviation**2).mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.1 / deviation.size))
    assert abs(deviation).max() < 6.5
    ratio = counts.var(axis=0, ddof=1) / variance
    assert ratio.mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.1 / (number * ratio.size)))
    assert abs(ratio - 1.0).max() < 6.5 * np.sqrt(2.1 / number)


def test_the_photon_transfer_curve_gives_gain_and_read_noise() -> None:
    """Variance against mean (EMVA 1288): the slope is 1/gain, with the read noise at zero.

    The variance is that of differences of two exposures, which fixed patterns leave alone.
    """
    array = DetectorArray(REAL, S, P, pattern_seed=4)
    dark = exposures(array, even(0.0), 2, 50)
    mean, variance = [dark.mean()], [(dark[0] - dark[1]).var() / 2.0]
    for number, level in enumerate((100.0, 1000.0, 4000.0, 9000.0, 18_000.0, 27_000.0)):
        pair = exposures(array, even(level), 2, number)
        mean.append(pair.mean())
        variance.append((pair[0] - pair[1]).var() / 2.0)
    weight = 1.0 / (np.array(variance) * np.sqrt(2.0 / (S * P)))
    offset = array.pattern.offset_counts.mean()
    (slope, floor), covariance = np.polyfit(
        np.array(mean) - offset, variance, 1, w=weight, cov="unscaled"
    )
    slope_deviation, floor_deviation = np.sqrt(np.diag(covariance))
    assert slope == pytest.approx(1.0 / 12.0, abs=5.0 * slope_deviation)
    assert floor == pytest.approx(900.0 / 144.0 + 1.0 / 12.0, abs=5.0 * floor_deviation)
    assert slope_deviation < 0.01 / 12.0


@pytest.mark.parametrize("level", [1000.0, 5000.0, 20_000.0])
def test_the_response_pattern_grows_with_the_light(level: float) -> None:
    """Pattern variance = (PRNU mean)^2 + the offset's; photon noise grows with the root alone."""
    detector = replace(REAL, dark_electrons=0.0, ambient_electrons=0.0)
    array = DetectorArray(detector, S, P, pattern_seed=1)
    number = 60
    counts = exposures(array, even(level), number)
    temporal = counts.var(axis=0, ddof=1).mean() / number
    spatial = counts.mean(axis=0).var() - temporal
    due = (0.02 * level / 12.0) ** 2 + 1.5**2
    # Of a normal pattern of n pixels, the variance has the deviation sqrt(2 / n).
    assert spatial == pytest.approx(due, rel=5.0 * np.sqrt(2.1 / (S * P)) * (1 + temporal / due))


def test_the_dark_pattern_is_in_the_dark_and_positive() -> None:
    dark = DetectorArray(REAL, S, 20_000, pattern_seed=6).pattern.dark_electrons
    assert dark.min() > 0.0
    assert dark.mean() == pytest.approx(150.0, abs=5.0 * 60.0 / np.sqrt(dark.size))
    assert dark.std() / dark.mean() == pytest.approx(0.4, abs=0.02)
    none = DetectorArray(replace(REAL, dark_electrons=0.0), S, P).pattern.dark_electrons
    assert (none == 0.0).all()


def test_patterns_are_those_of_the_sensor_and_the_seed() -> None:
    two, four = (DetectorArray(REAL, n, P, pattern_seed=8).pattern for n in (2, 4))
    other = DetectorArray(REAL, 2, P, pattern_seed=7).pattern
    for name in ("response", "dark_electrons", "offset_counts"):
        mine, more, theirs = (getattr(pattern, name) for pattern in (two, four, other))
        np.testing.assert_array_equal(mine, more[:2])
        assert (mine != theirs).mean() > 0.99
        assert (more[0] != more[1]).mean() > 0.99
        assert abs(np.corrcoef(more[0], more[3])[0, 1]) < 5.0 / np.sqrt(P)


def test_the_same_generator_gives_the_same_counts_and_another_seed_others() -> None:
    background = np.tile(np.linspace(0.0, 900.0, P), (S, 1))
    signal = np.zeros((8, S, P))
    signal[:, :, 700:730] = 5000.0
    first, again, other = (
        DetectorArray(REAL, S, P, pattern_seed=2, background_electrons=background).expose(
            signal, generator(seed)
        )
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.8
    assert (first[0] != first[1]).mean() > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("bits", range(8, 17))
def test_every_depth_clips_at_zero_and_full_scale(bits: int) -> None:
    detector = replace(REAL, bits=bits, electrons_per_count=0.6, offset_counts=0.0)
    ramp = np.tile(np.linspace(0.0, 44_000.0, P), (S, 1))
    array = DetectorArray(
        replace(detector, ambient_electrons=0.0, dark_electrons=0.0),
        S,
        P,
        background_electrons=ramp,
    )
    counts = array.expose(np.zeros((20, S, P)), generator(bits))
    assert counts.min() == 0
    assert counts.max() == 2**bits - 1
    due = (ramp * array.pattern.response / 0.6 + array.pattern.offset_counts).clip(0, 2**bits - 1)
    spread = np.sqrt((ramp + 900.0) / 0.36)
    # Nothing wraps: no count is farther from its mean than noise takes it.
    assert (abs(counts - due) < 7.0 * spread + 40.0).all()


def test_background_near_the_full_well_saturates_step_by_step() -> None:
    ramp = np.tile(np.linspace(44_000.0, 60_000.0, P), (S, 1))
    array = DetectorArray(REAL, S, P, background_electrons=ramp)
    counts = exposures(array, even(0.0), 50)
    full = 45_000.0 / 12.0
    last = counts[:, :, -100:] - array.pattern.offset_counts[:, -100:]
    assert last.mean() == pytest.approx(full, abs=5.0 * 2.55 / np.sqrt(last.size))
    assert last.std() == pytest.approx(np.sqrt(900.0 / 144.0 + 1.0 / 12.0), rel=0.03)


def test_small_read_noise_keeps_single_electrons() -> None:
    detector = replace(REAL, read_noise_electrons=0.0, electrons_per_count=1.0)
    array = DetectorArray(replace(detector, offset_nonuniformity_counts=0.0), S, P)
    counts = exposures(array, even(0.0), 300) - 64.0
    due = array.unlit_electrons
    deviation = (counts.mean(axis=0) - due) / np.sqrt(due / 300.0)
    assert (deviation**2).mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.1 / deviation.size))


def test_a_bright_line_blooms_over_dark_pixels_and_not_over_the_next_line() -> None:
    """The charge that the counts tell of is what was collected, less what was drained."""
    detector = replace(IDEAL, blooming=1.0, ambient_electrons=20.0, read_noise_electrons=5.0)
    signal = np.zeros((S, 400))
    signal[1, 200] = 50.0 * 45_000.0
    array = DetectorArray(detector, S, 400)
    counts = exposures(array, signal, 40)
    electrons = ((counts - 64.0) * 12.0).sum(axis=2)
    noise = np.sqrt(50.0 * 45_000.0 + 400 * (20.0 + 25.0 + 12.0))
    assert electrons[:, 1].mean() == pytest.approx(
        51.0 * 45_000.0 - 45_000.0 + 400 * 20.0, abs=5.0 * noise / np.sqrt(40)
    )
    assert (counts[:, 1, 180:221] > 3700.0).all()
    for line in (0, 2, 3):
        assert counts[:, line].max() < 64.0 + 10.0
    drained = exposures(DetectorArray(replace(detector, blooming=0.3), S, 400), signal, 40)
    assert ((drained - 64.0) * 12.0)[:, 1].sum(axis=1).max() < 0.15 * electrons[:, 1].min()
    assert drained[:, 1, [199, 201]].min() > 3700.0


@pytest.mark.parametrize("column", [0, 1, P - 1])
def test_charge_leaves_over_the_ends_of_a_line(column: int) -> None:
    detector = replace(REAL, blooming=0.9)
    signal = np.zeros((S, P))
    signal[1, column] = signal[2, column] = 1e6
    counts = exposures(DetectorArray(detector, S, P), signal, 4)
    far = counts[:, 1:3, 1000]
    assert far.max() < 200.0
    assert counts[:, :, column][:, 1:3].min() > 3600.0
    # The far end of the line, and the neighbouring lines' ends, saw nothing.
    assert counts[:, 1:3, P - 1 - column].max() < 200.0
    assert counts[:, [0, 3]].max() < 200.0


def test_charge_does_not_flow_from_the_end_of_a_line_to_the_start_of_the_next() -> None:
    """Both are lit, so that they follow one another among the pixels that are simulated."""
    signal = np.zeros((2, S, P))
    signal[0, 1, P - 1] = signal[0, S - 1, P - 1] = 1e6
    signal[0, 2, :3] = signal[1, 0, :3] = 50.0
    array = DetectorArray(replace(REAL, blooming=1.0), S, P)
    counts = array.expose(signal, generator(2))
    assert counts[0, [1, S - 1], P - 3 :].min() > 3600
    assert counts[0, 2, :3].max() < 200
    assert counts[1, 0, :3].max() < 200


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), blooming=st.sampled_from([0.0, 0.7]))
def test_lit_pixels_do_not_touch_dark_ones_that_nothing_flows_to(
    seed: int, blooming: float
) -> None:
    rng = generator(seed)
    signal = np.zeros((2, S, 300))
    place = rng.integers(0, signal.size, 30)
    signal.reshape(-1)[place] = 3000.0
    array = DetectorArray(replace(REAL, blooming=blooming), S, 300)
    lit = array.expose(signal, generator(seed))
    dark = array.expose(np.zeros_like(signal), generator(seed))
    np.testing.assert_array_equal(lit[signal == 0.0], dark[signal == 0.0])


def test_nominal_pixels_alone_are_the_detectors_own_matter() -> None:
    signal = np.zeros((S, P))
    for field, value in (("response_nonuniformity", 0.01), ("blooming", 0.5)):
        with pytest.raises(InvalidParameter, match=f"{field} is {value}; nominal pixels have 0"):
            replace(IDEAL, **{field: value}).expose(signal, generator(1))


@pytest.mark.parametrize(
    ("field", "value", "right"),
    [
        ("dark_electrons", -1.0, "zero or positive"),
        ("dark_electrons", np.nan, "zero or positive"),
        ("offset_nonuniformity_counts", -0.1, "zero or positive"),
        ("response_nonuniformity", -0.01, "from 0 to 0.2"),
        ("response_nonuniformity", 0.3, "from 0 to 0.2"),
        ("dark_nonuniformity", -1.0, "from 0 to 10"),
        ("blooming", 1.1, "from 0 to 1"),
        ("blooming", np.nan, "from 0 to 1"),
    ],
)
def test_parameters_without_meaning_are_refused(field: str, value: float, right: str) -> None:
    with pytest.raises(InvalidParameter, match=f"{field} is {value}; it must be {right}"):
        replace(IDEAL, **{field: value})


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("sensors", {"sensors": 0}),
        ("pixels", {"pixels": 0}),
        ("pattern_seed", {"pattern_seed": -1}),
        ("background_electrons", {"background_electrons": np.zeros((S, P + 1))}),
        ("background_electrons", {"background_electrons": np.full((S, P), -1.0)}),
        ("background_electrons", {"background_electrons": np.full((S, P), np.inf)}),
    ],
)
def test_devices_that_cannot_be_are_refused(field: str, values: dict[str, object]) -> None:
    with pytest.raises(InvalidParameter, match=field) as refused:
        DetectorArray(REAL, **({"sensors": S, "pixels": P} | values))  # type: ignore[arg-type]
    assert field in refused.value.context


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_signals_that_cannot_be_are_refused(value: float) -> None:
    signal = np.zeros((S, P))
    signal[2, 7] = value
    for device in (DetectorArray(REAL, S, P), IDEAL):
        with pytest.raises(InvalidParameter, match=f"signal_electrons has {value}"):
            device.expose(signal, generator(1))
    with pytest.raises(InvalidParameter, match="it must end with"):
        DetectorArray(REAL, S, P).expose(signal[:, 1:], generator(1))
