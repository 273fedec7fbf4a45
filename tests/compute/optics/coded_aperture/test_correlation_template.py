"""Templates of a mask: each for one distance."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow, maximal_length_code
from compute.optics.coded_aperture.correlation_decoding import decode_mask, read_by_correlation
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.optics.coded_aperture.template_from_optics import mask_template
from compute.optics.profiles.profile_loader import load_profile
from compute.optics.profiles.profile_optics import light_source, mask_optics
from compute.signal.coded_aperture.shadow_template import ShadowTemplate
from tests.compute.optics.coded_aperture.mask_sensors import sensor_behind

CODA = load_profile("coda-mpx30")


def windows() -> MaskOptics:
    optics = mask_optics(CODA, light_source(CODA))
    assert optics is not None
    return optics


def template(optics: MaskOptics, sensor: int, distance_mm: float) -> ShadowTemplate:
    """Of a point on the sensor's axis, as far along Z."""
    placed = CODA.sensors[sensor]
    start, aim = np.array(placed.position_mm), np.array(placed.aim_mm)
    return mask_template(optics, start + (aim - start) * distance_mm / aim[2], sensor)


def volume(distance_mm: float) -> np.ndarray:
    """Points of CODA's working volume at a distance."""
    x, y = np.meshgrid(np.linspace(-700.0, 700.0, 5), np.linspace(-700.0, 700.0, 5))
    return np.column_stack([x.ravel(), y.ravel(), np.full(25, distance_mm)])


def test_one_template_fits_one_distance() -> None:
    """Prints the errors of noiseless shadows by the template for 3 m, and by their own."""
    optics = windows()
    for distance, sign in ((2500.0, -1.0), (3000.0, 0.0), (3500.0, 1.0)):
        points = volume(distance)
        lines, exact = optics.solid_angles(points).solid_angle_sr, optics.readings(points)
        fixed, own = (
            np.stack(
                [
                    read_by_correlation(lines[:, s], template(optics, s, at)) - exact[:, s]
                    for s in range(3)
                ],
                axis=1,
            )
            for at in (3000.0, distance)
        )
        print(
            f"{distance:.0f} mm: template for 3 m off by {fixed.min():+.3f} to {fixed.max():+.3f}, "
            f"median {np.median(fixed):+.3f} px; its own by {own.min():+.3f} to {own.max():+.3f}, "
            f"{own.std():.3f} px RMS"
        )
        # The method's own error, off the axis and between pixels.
        assert own.std() < 0.04
        assert abs(np.median(own)) < 0.02
        if sign:
            assert sign * np.median(fixed) > 2.0 * abs(np.median(own))
            assert np.sqrt(np.square(fixed).mean()) > 2.0 * own.std()


def test_the_error_is_of_the_shadows_scale() -> None:
    """1 + gap/Z by the edges of a code behind air: what a template stretched by it takes away."""
    gap = 10.0
    window = CodedWindow(maximal_length_code(7), 0.15, gap)
    optics = MaskOptics(window, [sensor_behind(gap, pixels=2048)], pixel_height_mm=0.2)
    near, far = np.array([0.0, 0.0, 400.0]), np.array([0.0, 0.0, 4000.0])
    shadows = optics.solid_angles(np.array([near, far])).solid_angle_sr[:, 0]
    lit = [np.flatnonzero(shadow > 0.5 * shadow.max()) for shadow in shadows]
    widths = [float(np.ptp(pixels)) for pixels in lit]
    assert widths[0] / widths[1] == pytest.approx((1 + gap / 400) / (1 + gap / 4000), rel=1e-3)
    peak = [float(decode_mask(shadows[0], shadows[i]).peak) for i in (0, 1)]
    assert peak[0] > 0.99
    assert peak[1] < 0.9


def test_it_reads_its_own_point() -> None:
    optics = windows()
    for sensor in range(3):
        found = template(optics, sensor, 2700.0)
        assert found.reading_px == pytest.approx(1023.5, abs=1.0)
        # Not to the last digit: the line's ends cut the shadow.
        assert float(read_by_correlation(found.cells, found)) == pytest.approx(
            found.reading_px, abs=0.01
        )
        lines = np.stack([found.cells, 3.0 * found.cells + 7.0])
        np.testing.assert_allclose(read_by_correlation(lines, found), found.reading_px, atol=0.01)


@pytest.mark.parametrize(
    ("point", "sensor", "match"),
    [
        ((0.0, 0.0, 3000.0), 3, "sensor is 3; it must be 0 to 2"),
        ((0.0, 0.0, 3000.0), -1, "sensor is -1"),
        ((0.0, 0.0, -3000.0), 0, "throws no shadow"),
        ((np.nan, 0.0, 3000.0), 0, "throws no shadow"),
        ((0.0, 3000.0), 0, "point_mm has the shape"),
    ],
)
def test_what_is_refused(point: tuple[float, ...], sensor: int, match: str) -> None:
    with pytest.raises(InvalidParameter, match=match):
        mask_template(windows(), point, sensor)
