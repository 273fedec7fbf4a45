"""TrackOptics: light lines across a plate are read to the plate's resolution."""

import numpy as np
import pytest
from scipy.special import ndtr

from compute.optics.coded_aperture.gray_decoding import GrayFlag, read_gray
from compute.optics.coded_aperture.gray_plate import GrayPlate
from compute.optics.coded_aperture.gray_plate_optics import TrackOptics
from compute.optics.pixel_solid_angles import PixelSolidAngles

PLATE = GrayPlate()
STEPS = 2**PLATE.bits
LIGHT_SR = 3e-6


class GaussianLines:
    """Lines whose centres are the points' x, in mm on the plate, integrated step by step."""

    def __init__(self, sigma_mm):
        self.sigma_mm = sigma_mm

    def solid_angles(self, points_mm):
        sigma = self.sigma_mm / PLATE.step_mm
        centre = points_mm[:, 0] / PLATE.step_mm - 0.5
        reach = int(np.ceil(7.0 * sigma)) + 1
        first = np.rint(centre).astype(np.int64) - reach
        edges = first[:, None] + np.arange(2 * reach + 2) - 0.5
        light = LIGHT_SR * np.diff(ndtr((edges - centre[:, None]) / sigma), axis=1)
        return PixelSolidAngles(first[:, None], light[:, None, :])


def along_plate(x_mm):
    return np.column_stack([x_mm, np.zeros_like(x_mm), np.ones_like(x_mm)])


@pytest.mark.parametrize("sigma_mm", [0.01, 0.025, 0.06])
def test_tracks_collect_what_the_plate_says(sigma_mm):
    x = np.linspace(-0.4, PLATE.length_mm + 0.4, 401)
    found = TrackOptics(GaussianLines(sigma_mm), PLATE).solid_angles(along_plate(x))
    assert found.solid_angle_sr.shape == (401, 1, PLATE.tracks)
    assert not found.first_px.any()
    expected = LIGHT_SR * PLATE.outputs(x, np.full_like(x, sigma_mm))
    np.testing.assert_allclose(found.solid_angle_sr[:, 0], expected, rtol=0, atol=1e-9 * LIGHT_SR)


def test_lines_beside_the_plate_are_dark():
    x = np.array([-5.0, PLATE.length_mm + 5.0])
    found = TrackOptics(GaussianLines(0.02), PLATE).solid_angles(along_plate(x))
    assert not found.solid_angle_sr.any()


def test_readings_to_the_resolution_of_the_plate():
    sigma = 0.6 * PLATE.cell_mm
    x = np.random.default_rng(1).uniform(5 * sigma, PLATE.length_mm - 5 * sigma, 2000)
    found = TrackOptics(GaussianLines(sigma), PLATE).solid_angles(along_plate(x))
    reading = read_gray(PLATE, found.solid_angle_sr[:, 0], line_sigma_mm=sigma)
    assert not (reading.flags & (GrayFlag.NO_LIGHT | GrayFlag.INCONSISTENT)).any()
    error = reading.position_mm - x
    assert np.abs(error).max() <= 0.5 * PLATE.step_mm * (1.0 + 1e-6)
    # As a rounding errs: evenly over a step.
    assert np.std(error) == pytest.approx(PLATE.quantisation_sigma_mm, rel=0.05)
