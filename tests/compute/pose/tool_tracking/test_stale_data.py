"""Frozen images: found at once where readings never repeat, and never where they do by chance."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from compute.pose.tool_tracking.exposure_history import FALSE_ALARM_PROBABILITY, StaleDataDetector

Array = NDArray[np.float64]

SIGMA_PX = 0.05
PLACES_PX = np.array([[300.25], [811.5], [1200.75], [1733.1]])
"""Of one marker on four sensors."""
SIGMAS_PX = np.full_like(PLACES_PX, SIGMA_PX)


def live(rng: np.random.Generator, step_px: float = 0.0, places_px: Array = PLACES_PX) -> Array:
    """Readings of what rests, in steps as large as coarse counts make them; 0: none."""
    read = places_px + rng.normal(0.0, SIGMA_PX, places_px.shape)
    return np.round(read / step_px) * step_px if step_px else read


def shown(
    image: StaleDataDetector, exposures: int, rng: np.random.Generator, step_px: float
) -> int:
    """Show live exposures; return how many were taken for frozen."""
    frozen = 0
    for _ in range(exposures):
        image.add_exposure(None, live(rng, step_px), SIGMAS_PX)
        frozen += image.is_stale(None)
    return frozen


def test_the_second_of_two_equal_exposures_is_frozen():
    rng = np.random.default_rng(1)
    image = StaleDataDetector()
    assert shown(image, 100, rng, 0.0) == 0
    last = live(rng)
    for times in range(1, 4):
        image.add_exposure(None, last, SIGMAS_PX)
        assert image.is_stale(None) == (times > 1)
    image.add_exposure(None, live(rng), SIGMAS_PX)
    assert not image.is_stale(None)


def test_a_device_of_which_nothing_is_known_has_to_repeat_fifteen_readings():
    """One of four repeats: as of three pixels whose counts have a deviation of 0.4, rounded."""
    image = StaleDataDetector()
    seen = []
    for _ in range(6):
        image.add_exposure(None, PLACES_PX, SIGMAS_PX)
        seen.append(image.is_stale(None))
    assert seen == [False] * 4 + [True] * 2  # 0, 4, 8, ... readings
    edges = np.arange(-5.5, 6.5)
    means = np.linspace(-0.5, 0.5, 101)[:, None]
    shares = np.diff(norm.cdf((edges - means) / 0.4), axis=1)
    assert (shares**2).sum(axis=1).mean() ** 3 == pytest.approx(0.25, rel=0.3)


@pytest.mark.parametrize("step_px", [0.05, 0.15])
def test_coarse_counts_repeat_and_are_not_frozen(step_px: float):
    """Single readings repeat in a quarter, or more than half, of the exposures of what rests."""
    rng = np.random.default_rng(2)
    image = StaleDataDetector()
    # What moves never repeats, and says nothing of how often what rests does.
    for frame in range(2000):
        image.add_exposure(None, PLACES_PX + frame, SIGMAS_PX)
    shown(image, 200, rng, step_px)
    assert shown(image, 3000, rng, step_px) == 0
    many = np.broadcast_to(PLACES_PX, (4, 2000))
    equal = (live(rng, step_px, many) == live(rng, step_px, many)).mean()
    assert equal > 0.2
    # It is still found: after as many readings as their chance asks for.
    last = live(rng, step_px)
    times = 0
    while not image.is_stale(None):
        image.add_exposure(None, last, SIGMAS_PX)
        times += 1
    assert 4 * (times - 1) == pytest.approx(
        np.log(FALSE_ALARM_PROBABILITY) / np.log(equal), rel=0.25, abs=4
    )


def test_a_loop_of_images_is_frozen_whatever_is_lit():
    rng = np.random.default_rng(3)
    image = StaleDataDetector()
    for _ in range(100):
        image.add_exposure(0, live(rng), SIGMAS_PX)
    cycle = [live(rng) for _ in range(8)]
    seen = []
    for _ in range(3):
        for marker, readings in enumerate(cycle):
            # One sensor sees each: one reading is too few, those of some markers are not.
            one = np.where(np.arange(4)[:, None] == marker % 4, readings, np.nan)
            image.add_exposure(marker, one, SIGMAS_PX)
            seen.append(image.is_stale((0,)))
    first = seen.index(True)
    assert 8 < first <= 8 + 3
    assert all(seen[first:])
    image.add_exposure(0, live(rng), SIGMAS_PX)
    assert not image.is_stale((0,))


def test_one_strobed_marker_whose_exposures_do_not_change():
    rng = np.random.default_rng(4)
    image = StaleDataDetector()
    for _ in range(100):
        image.add_exposure(0, live(rng), SIGMAS_PX)
    last = live(rng)
    for times in range(1, 6):
        image.add_exposure(0, last, SIGMAS_PX)
        image.add_exposure(1, live(rng), SIGMAS_PX)
        assert image.is_stale((0,)) == (times > 1)
        assert not image.is_stale((1,))


def test_nothing_seen_is_no_image():
    image = StaleDataDetector()
    for _ in range(50):
        image.add_exposure(None, np.full((4, 1), np.nan), SIGMAS_PX)
    assert not image.is_stale(None)


def test_what_the_strobe_showed_before_is_no_measure():
    image = StaleDataDetector()
    for _ in range(9):
        image.add_exposure(None, PLACES_PX, SIGMAS_PX)
    image.add_exposure(0, PLACES_PX, SIGMAS_PX)
    assert not image.is_stale((0,))
