"""Bad pixels from scans with moving lights."""

import numpy as np

from compute.signal.bad_pixel_monitor import MIN_SCANS, BadPixelMonitor
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
    found = monitor.to_calibration(10.0, 20.0, 100.0, 65535)
    assert np.array_equal(found.bad_pixels, bad)
    assert found.read_noise_electrons == 20.0


def test_good_sensors_have_none_even_below_still_light():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        sensor = Sensor.make(SensorDesign(pixels=PIXELS, prnu=0.03, dsnu_counts=1.0), rng)
        monitor = BadPixelMonitor(PIXELS)
        monitor.add(scans(sensor, 600, rng, still=rng.uniform(20.0, 230.0)))
        assert not monitor.find(SIGMA).any()
