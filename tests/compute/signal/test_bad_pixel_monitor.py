"""Bad pixels from scans with moving lights."""

import numpy as np
from scipy.special import ndtr

from compute.signal.bad_pixel_monitor import MIN_SCANS, BadPixelMonitor, masking_calibration
from compute.signal.radiometric_calibration import BadPixel
from validation.pixels.case import PIXELS, line_electrons
from validation.pixels.emva_sensor import Sensor, SensorDesign

SIGMA = 2.1


def scans(sensor, count, rng, *, still=None):
    """A line that moves over the whole sensor, and one that stands still."""
    light = line_electrons(rng.uniform(0.0, PIXELS - 1.0, count), 60_000.0, 0.0)
    if still is not None:
        light = light + line_electrons(np.full(count, still), 60_000.0, 0.0)
    return sensor.expose(light + 20.0)


def test_bad_pixels_are_named_while_a_light_moves():
    rng = np.random.default_rng(3)
    design = SensorDesign(
        pixels=PIXELS, prnu=0.03, dsnu_counts=1.0, hot=(50,), dead=(100,), stuck=(150,)
    )
    monitor = BadPixelMonitor(PIXELS)
    sensor = Sensor.make(design, rng)
    monitor.add(scans(sensor, MIN_SCANS - 1, rng))
    assert not monitor.find(SIGMA).any()
    for _ in range(8):
        monitor.add(scans(sensor, 250, rng))
    bad = monitor.find(SIGMA)
    assert {int(pixel): int(bad[pixel]) for pixel in np.flatnonzero(bad)} == {
        50: BadPixel.HOT,
        100: BadPixel.DEAD,
        150: BadPixel.STUCK,
    }
    found = masking_calibration(bad, 10.0, 20.0, 100.0, 65535)
    assert np.array_equal(found.bad_pixels, bad)
    assert found.read_noise_electrons == 20.0


def test_good_sensors_have_none_even_below_still_light():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        sensor = Sensor.make(SensorDesign(pixels=PIXELS, prnu=0.03, dsnu_counts=1.0), rng)
        monitor = BadPixelMonitor(PIXELS)
        monitor.add(scans(sensor, 600, rng, still=rng.uniform(20.0, 230.0)))
        assert not monitor.find(SIGMA).any()


def constant(counts, where, value, rng):
    """Noise of two counts about a level, and one pixel that never changes."""
    scans = np.rint(counts + 2.0 * rng.standard_normal((600, PIXELS))).clip(0, 4095)
    scans[:, where] = value
    return scans.astype(np.uint16)


def test_pixel_that_may_be_cut_off_at_zero_is_stuck_only_where_light_passed():
    rng = np.random.default_rng(5)
    monitor = BadPixelMonitor(PIXELS)
    scans = constant(0.0, 80, 0, rng)
    monitor.add(scans)
    assert not monitor.find(SIGMA).any()
    scans[:50, 70:90] += 500
    scans[:, 80] = 0
    monitor.add(scans)
    assert np.flatnonzero(monitor.find(SIGMA)).tolist() == [80]


def test_still_saturated_light_is_not_stuck_but_a_lone_full_pixel_is():
    rng = np.random.default_rng(6)
    monitor = BadPixelMonitor(PIXELS)
    scans = constant(100.0, 80, 4095, rng)
    scans[:, 150] += 1900
    scans[:, 151:153] = 4095
    scans[:, 153] += 1700
    monitor.add(scans)
    bad = monitor.find(SIGMA, 4095)
    assert {int(one): int(bad[one]) for one in np.flatnonzero(bad)} == {80: BadPixel.STUCK}


def test_quiet_sensor_whose_pixels_hardly_change_has_no_stuck_ones():
    rng = np.random.default_rng(7)
    offsets = 100.0 + rng.uniform(-0.5, 0.5, PIXELS)
    scans = np.rint(offsets + 0.15 * rng.standard_normal((2000, PIXELS))).astype(np.uint16)
    monitor = BadPixelMonitor(PIXELS)
    monitor.add(scans)
    assert not monitor.find(0.33).any()


def test_still_line_sharper_than_a_pixel_is_not_hot_where_its_width_is_known():
    rng = np.random.default_rng(8)
    edges = np.arange(PIXELS + 1) - 0.5 - 120.0
    line = 2000.0 * np.diff(ndtr(edges / 0.3))
    scans = np.rint(100.0 + line + 2.0 * rng.standard_normal((600, PIXELS)))
    scans[:, 40] += 400.0
    monitor = BadPixelMonitor(PIXELS)
    monitor.add(scans.astype(np.uint16))
    bad = monitor.find(SIGMA, 4095, 0.3)
    assert {int(one): int(bad[one]) for one in np.flatnonzero(bad)} == {40: BadPixel.HOT}
