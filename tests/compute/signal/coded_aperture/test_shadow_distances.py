"""A coded window's shadows from a whole volume: one template, its scale free, and correlation."""

import numpy as np
import pytest

from compute.optics.coded_aperture.correlation_decoding import decode_mask
from compute.optics.profiles.profile_loader import load_profile
from compute.optics.profiles.profile_optics import light_source, mask_optics
from compute.signal.coded_aperture.shadow_fit import ShadowFitter, ShadowSettings
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.coded_aperture.coded_aperture_scenes import woven

CODA = load_profile("coda-mpx30")


@pytest.mark.slow
def test_the_volume_of_a_device() -> None:
    """Prints the errors of noiseless shadows over the volume, by distance and method.

    The code is longer than the sensor, so that beyond the line its template is unknown.
    """
    optics = mask_optics(CODA, light_source(CODA))
    assert optics is not None
    placed, number = CODA.sensors[1], 1
    start, aim = np.array(placed.position_mm), np.array(placed.aim_mm)
    axis = start + (aim - start) * 3000.0 / aim[2]
    template = woven(
        optics, 4, axis, sensor=number, direction=placed.measured_direction, dark_beyond=False
    )
    noise = SensorNoise.of(80.0, 60.0, 40.0, 4095)
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-700.0, 700.0, 7)] * 2))
    for distance in (2500.0, 3000.0, 3500.0):
        points = np.column_stack([x, y, np.full(len(x), distance)])
        light = optics.solid_angles(points).solid_angle_sr[:, number]
        exact = optics.readings(points)[:, number]
        counts = np.rint(2500.0 * light / light.max() + 60.0).astype(np.uint16)
        plain = decode_mask(counts, template.pixel_values).shift_px + template.reading_px - exact
        errors = {"correlation": plain}
        for name, free in (("fit", False), ("fit with scale", True)):
            fit = ShadowFitter(template, 2048, noise, ShadowSettings(fit_scale=free)).fit(counts)
            assert fit.found.all()
            assert not (fit.flags & PeakFlag.AMBIGUOUS).any()
            errors[name] = fit.shift_px + template.reading_px - exact
            if free:
                magnified = (1 + CODA_GAP_MM / distance) / (1 + CODA_GAP_MM / 3000.0)
                assert np.median(fit.scale) == pytest.approx(magnified, abs=5e-5)
                # The shadow off the axis is another than on it, and the fit says so.
                assert (fit.flags & PeakFlag.POOR_FIT > 0).mean() > 0.5
        rms = {name: float(np.sqrt(np.mean(error**2))) for name, error in errors.items()}
        print(f"{distance:.0f} mm: " + ", ".join(f"{n} {v:.4f} px RMS" for n, v in rms.items()))
        assert rms["fit with scale"] < 0.5 * rms["correlation"]
        assert rms["fit with scale"] < 0.015


CODA_GAP_MM = 12.0
