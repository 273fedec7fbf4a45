"""Radiometric calibration of sensors after EMVA 1288, made by the case's own sensor model."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.signal.capture_statistics import CaptureAccumulator, CaptureStatistics
from compute.signal.radiometric_calibration import (
    BadPixel,
    RadiometricCalibration,
    estimate,
)
from validation.pixels.emva_sensor import Sensor, SensorDesign

PIXELS = 512
LEVELS = (4000.0, 12_000.0, 24_000.0, 36_000.0, 48_000.0)
DESIGN = SensorDesign(
    pixels=PIXELS,
    prnu=0.02,
    dsnu_counts=3.0,
    hot=(100,),
    hot_electrons=600.0,
    dead=(200,),
    stuck=(300,),
)


def captures(sensor, electrons, frames=64):
    """Statistics of exposures to the same light."""
    light = np.broadcast_to(np.asarray(electrons, float), (frames, PIXELS))
    return CaptureStatistics.of(sensor.expose(light))


def lamp(strength=0.15):
    """An uneven lamp."""
    return 1.0 - strength * np.linspace(-1.0, 1.0, PIXELS) ** 2


@pytest.fixture(scope="module")
def sensor():
    return Sensor.make(DESIGN, np.random.default_rng(3))


@pytest.fixture(scope="module")
def scenes(sensor):
    return captures(sensor, 0.0), [captures(sensor, level * lamp()) for level in LEVELS]


@pytest.fixture(scope="module")
def calibration(scenes):
    return estimate(*scenes, relative_light=LEVELS, temperature_c=31.5)


def test_estimate_finds_what_the_sensor_is(calibration, sensor):
    # 3 levels x 64 captures x 500 pixels: the gain's standard error is 0.5 %.
    assert calibration.gain_electrons_per_count == pytest.approx(10.0, rel=0.025)
    assert calibration.read_noise_electrons == pytest.approx(20.0, rel=0.03)
    assert calibration.dsnu_counts == pytest.approx(3.0, rel=0.12)
    assert calibration.prnu == pytest.approx(0.02, rel=0.12)
    assert calibration.illumination_range == pytest.approx(0.16, rel=0.15)
    good = calibration.good
    assert np.std((calibration.dark_offset - sensor.offset)[good]) < 0.35
    # Smooth unevenness is the lamp's: five coefficients of 512 responses.
    ratio = (calibration.response / sensor.response)[good]
    assert np.std(ratio / ratio.mean()) < 0.02 * np.sqrt(5 / PIXELS) + 0.002
    assert np.mean(calibration.response[good]) == pytest.approx(1.0)
    assert calibration.captures == 6 * 64
    assert calibration.temperature_c == 31.5


def test_estimate_names_bad_pixels_and_no_others(calibration):
    assert calibration.bad_pixels[100] == BadPixel.HOT
    assert calibration.bad_pixels[200] == BadPixel.DEAD
    assert calibration.bad_pixels[300] == BadPixel.STUCK
    assert np.flatnonzero(calibration.bad_pixels).tolist() == [100, 200, 300]


def test_estimate_linearity_is_that_of_the_converter():
    design = SensorDesign(pixels=PIXELS, saturation_curve=0.05)
    sensor = Sensor.make(design, np.random.default_rng(5))
    flats = [captures(sensor, level) for level in LEVELS]
    found = estimate(captures(sensor, 0.0), flats, relative_light=LEVELS)
    counts = np.linspace(500.0, 5000.0, 10)
    electrons = counts * 10.0
    bent = (electrons - 0.05 * electrons**2 / design.full_well_electrons) / 10.0
    first, second = found.linearity
    ratio = bent * (1.0 + first * bent + second * bent**2) / counts
    assert np.ptp(ratio) < 1e-3
    assert found.linearity_error == pytest.approx(0.012, abs=0.004)
    # Without the light's ratios nothing is said.
    unknown = estimate(captures(sensor, 0.0), flats)
    assert unknown.linearity == (0.0, 0.0)
    assert unknown.linearity_error is None


def test_dark_current_by_two_exposure_times(sensor, scenes):
    warm = captures(sensor, 200.0)
    found = estimate(
        *scenes, exposure_s=0.001, other_dark=warm, other_exposure_s=0.011
    ).dark_current_counts_per_s
    assert np.median(found) == pytest.approx(2000.0, rel=0.02)


def test_document_returns_the_same_calibration(calibration):
    document = calibration.to_document()
    again = RadiometricCalibration.from_document(document)
    assert again.content_hash() == calibration.content_hash()
    document["prnu"] = 0.5
    assert RadiometricCalibration.from_document(document).content_hash() != again.content_hash()
    del document["prnu"]
    with pytest.raises(InvalidParameter, match="it must have"):
        RadiometricCalibration.from_document(document)


def test_statistics_are_the_same_in_parts(sensor):
    frames = sensor.expose(np.full((40, PIXELS), 5000.0))
    accumulator = CaptureAccumulator()
    for part in np.array_split(frames, 7):
        accumulator.add(part)
    whole, parts = CaptureStatistics.of(frames), accumulator.statistics()
    for name in ("mean", "variance", "minimum", "maximum"):
        assert np.allclose(getattr(whole, name), getattr(parts, name), rtol=1e-12)
    assert np.median(whole.variance) == pytest.approx(54.0, rel=0.05)


def test_variance_ignores_flicker_of_the_lamp(sensor):
    flicker = 5000.0 * (1.0 + 0.02 * np.sin(np.arange(200.0)))[:, None]
    found = CaptureStatistics.of(sensor.expose(np.broadcast_to(flicker, (200, PIXELS))))
    assert np.median(found.variance) == pytest.approx(54.0, rel=0.05)


def _lit(sensor):
    light = np.zeros(PIXELS)
    light[240:262] = 200.0
    return captures(sensor, light)


def test_estimate_refuses_what_cannot_be(sensor, scenes):
    dark, flats = scenes
    for words, arguments in (
        ("there are 8 dark captures; there must be 16", (captures(sensor, 0.0, 8), flats)),
        ("there are 1 levels of light", (dark, flats[:1])),
        ("light in the dark captures: 22 pixels, the first of them 240", (_lit(sensor), flats)),
        ("counts above the dark ones", (dark, [dark, flats[0]])),
        ("saturated", (dark, [flats[0], captures(sensor, 90_000.0)])),
        ("varies by", (dark, [captures(sensor, 20_000.0 * lamp(0.7)), flats[0]])),
    ):
        with pytest.raises(InvalidParameter, match=words):
            estimate(*arguments)
    with pytest.raises(InvalidParameter, match=r"reach 1200 counts .* use less light"):
        estimate(dark, flats, full_scale_counts=1200)
    with pytest.raises(InvalidParameter, match="5 positive numbers"):
        estimate(dark, flats, relative_light=[1.0, 2.0])
