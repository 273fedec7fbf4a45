"""Line shapes by position beside comatic stripes of an oracle, and their Cramer-Rao bound."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.device_line_spread import device_line_spread
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_estimate import estimate_line_spread
from compute.signal.measured_line_spread import MeasuredLineSpread
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from tests.oracles.comatic_stripes import ComaticSensor

LIGHT, AMBIENT = 60_000.0, 20.0
FREE = FitSettings(
    search=CentroidSettings(threshold_fraction=0.1, min_width_px=2),
    width_log_sigma=np.inf,
    further_peaks=False,
)
NOISE = SensorNoise.of(10.0, 20.0, 100.0, 65535)


def moved(sensor: ComaticSensor, count: int, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Scans of a marker that moves through the field."""
    position = np.linspace(20.0, sensor.pixels - 21.0, count) + rng.uniform(-0.5, 0.5, count)
    return sensor.expose(position, LIGHT, AMBIENT, rng)


def known_width(width_px: float) -> FitSettings:
    return replace(FREE, width_px=width_px, width_log_sigma=0.0)


@pytest.mark.slow
@pytest.mark.parametrize(("blur_px", "flare"), [(1.0, 1.0), (0.7, 1.0)])
def test_fit_by_the_measured_shape_is_at_the_bound(blur_px: float, flare: float) -> None:
    sensor, rng = ComaticSensor(blur_px=blur_px, flare=flare), np.random.default_rng(11)
    shape = estimate_line_spread(moved(sensor, 1600, rng), FREE, NOISE)
    assert shape.reduced_chi2 == pytest.approx(1.0, abs=0.04)
    # The flare points outwards: skewness changes its sign along the sensor.
    assert shape.skewness[0] < -0.2
    assert shape.skewness[-1] > 0.2
    position = rng.uniform(40.0, 470.0, 1000)
    scans = sensor.expose(position, LIGHT, AMBIENT, rng)
    bound2 = np.mean([sensor.bound_px(float(one), LIGHT, AMBIENT) ** 2 for one in position])
    function, width_px = device_line_spread([shape], 1.0)
    ratios, flagged = [], []
    for given in (None, function):
        finder = FitFinder(1000, 512, known_width(width_px), NOISE, given, "cpu", 1)
        peaks = finder.find(scans)
        error = peaks.position_px[:, 0] - position
        ratios.append(float(np.sqrt(np.mean(error**2) / bound2)))
        flagged.append(float(np.mean((peaks.flags[:, 0] & int(PeakFlag.POOR_FIT)) != 0)))
        if given is not None:
            assert np.mean((error / peaks.sigma_px[:, 0]) ** 2) == pytest.approx(1.0, abs=0.2)
            assert abs(error.mean()) < 0.1 * np.sqrt(bound2) + 3.0 * np.sqrt(bound2 / 1000)
    # 1,000 errors: the ratio is known to 2.2 %.
    assert ratios[1] < 1.05 + 0.045
    assert ratios[0] > 3.0
    assert flagged[0] > 0.9
    assert flagged[1] < 0.02


@pytest.mark.slow
def test_kernel_and_definition_agree_with_shapes_of_two_sensors() -> None:
    sensor, rng = ComaticSensor(pixels=256), np.random.default_rng(12)
    shape = estimate_line_spread(moved(sensor, 500, rng), FREE, NOISE)
    function, width_px = device_line_spread([shape, None], 1.0)
    assert function.cumulative.shape[0] == 2
    position = rng.uniform(30.0, 220.0, 12)
    scans = sensor.expose(position, LIGHT, AMBIENT, rng)
    two = SensorNoise.of([10.0, 10.0], 20.0, 100.0, 65535)
    settings = known_width(width_px)
    kernel = FitFinder(12, 256, settings, two, function, "cpu", 1).find(scans)
    defined = fit_scans(scans, settings, two, function)
    assert kernel.position_px == pytest.approx(defined.position_px, abs=2e-5, nan_ok=True)
    # The second sensor is fitted by a Gaussian of the width that was given for it.
    error = np.abs(kernel.position_px[:, 0] - position)
    assert error[::2].max() < 0.03


@pytest.mark.slow
def test_document_gives_the_shape_again_and_others_are_refused() -> None:
    sensor, rng = ComaticSensor(pixels=256), np.random.default_rng(13)
    scans = moved(sensor, 600, rng)
    shape = estimate_line_spread(scans, FREE, NOISE)
    again = MeasuredLineSpread.from_document(shape.to_document())
    assert again.light.tobytes() == shape.light.tobytes()
    assert again.to_document() == shape.to_document()
    with pytest.raises(InvalidParameter, match="must have"):
        MeasuredLineSpread.from_document({"light": []})
    with pytest.raises(InvalidParameter, match="400 or more"):
        estimate_line_spread(scans[:100], FREE, NOISE)
    with pytest.raises(InvalidParameter, match="no line lies between pixels"):
        estimate_line_spread(np.concatenate([scans[:200], scans[-250:]]), FREE, NOISE)
    sharp = moved(replace(sensor, blur_px=0.35), 600, rng)
    with pytest.raises(InvalidParameter, match=r"cannot be told apart|400 or more"):
        estimate_line_spread(sharp, FREE, NOISE)
