"""Standard deviation of plain correlation against the Cramer-Rao bound."""

import numpy as np
import pytest

from compute.optics.coded_aperture.coded_window import CodedWindow, maximal_length_code
from compute.optics.coded_aperture.correlation_decoding import decode_mask
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.signal.cramer_rao import position_bound
from tests.compute.optics.coded_aperture.mask_sensors import sensor_behind


@pytest.mark.parametrize("read", [10.0, 60.0])
def test_how_far_plain_correlation_is_from_the_bound(read: float) -> None:
    """Prints the deviation of the decoded shift beside the bound, at two places in a pixel."""
    window = CodedWindow(maximal_length_code(6), 0.15, 10.0, 3.0, 1.5)
    optics = MaskOptics(
        window,
        [sensor_behind(10.0)],
        pixel_height_mm=0.2,
        emitter_width_mm=0.5,
        wavelength_nm=900.0,
        spectral_width_nm=50.0,
    )
    x = np.array([0.0, 40.0, 41.0])
    step = 1e-2
    points = np.array([(a + d, 0.0, 2000.0) for a in x for d in (-step, 0.0, step)])
    lines = optics.solid_angles(points).solid_angle_sr[:, 0].reshape(3, 3, -1)
    readings = optics.readings(points)[:, 0].reshape(3, 3)
    scale = 2000.0 / lines.max()
    template = lines[0, 1]
    rng = np.random.default_rng(11)
    for place in (1, 2):
        mean = scale * lines[place, 1]
        slope = (
            scale * (lines[place, 2] - lines[place, 0]) / (readings[place, 2] - readings[place, 0])
        )
        bound = float(position_bound(mean, slope, read**2, known_brightness=True))
        noisy = rng.poisson(mean, (400, mean.size)) + read * rng.standard_normal((400, mean.size))
        shift = decode_mask(noisy, template).shift_px
        ratio = float(shift.std(ddof=1)) / bound
        bias = float(shift.mean()) - (readings[place, 1] - readings[0, 1])
        print(
            f"read noise {read:.0f}: bound {bound:.4f} px, correlation {ratio:.2f} of it, ", end=""
        )
        print(f"off by {bias:+.4f} px")
        # 400 draws know a deviation to 3.5 %: nothing unbiased is below the bound.
        assert ratio > 0.85
        assert ratio < 5.0
        assert abs(bias) < 0.25
