"""Gray-coded plate: its tracks, and the light that the detectors behind them collect."""

import numpy as np
import pytest
from scipy.special import ndtr

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.gray_plate import GrayPlate, TrackOptics
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
    edges = np.arange(2**PLATE.gray_bits + 1) * PLATE.cell_mm
    on_cells = np.diff(ndtr((edges - x[:, None]) / sigma_mm), axis=1)
    expected = LIGHT_SR * on_cells @ PLATE.transparent
    np.testing.assert_allclose(found.solid_angle_sr[:, 0], expected, rtol=0, atol=1e-9 * LIGHT_SR)


def test_lines_beside_the_plate_are_dark():
    x = np.array([-5.0, PLATE.length_mm + 5.0])
    found = TrackOptics(GaussianLines(0.02), PLATE).solid_angles(along_plate(x))
    assert not found.solid_angle_sr.any()


def test_plate_by_default_has_twelve_bits_on_ten_millimetres() -> None:
    assert PLATE.bits == 12
    assert PLATE.length_mm == 10.0  # thesis, section 2.3
    assert PLATE.step_mm == pytest.approx(10.0 / 4096)
    assert PLATE.transparent.shape == (256, PLATE.tracks)


def test_each_cell_differs_from_the_next_in_one_gray_track() -> None:
    gray = PLATE.transparent[:, : PLATE.gray_bits]
    assert ((gray[1:] != gray[:-1]).sum(axis=1) == 1).all()
    assert len({tuple(row) for row in gray}) == 256


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gray_bits", 1),
        ("gray_bits", 13),
        ("analogue_bits", -1),
        ("analogue_bits", 13),
        ("length_mm", 0.0),
        ("length_mm", np.nan),
    ],
)
def test_a_plate_that_cannot_be_is_refused(field: str, value: float) -> None:
    with pytest.raises(InvalidParameter, match=f"{field} is {value}; it must be"):
        GrayPlate(**{field: value})  # type: ignore[arg-type]
