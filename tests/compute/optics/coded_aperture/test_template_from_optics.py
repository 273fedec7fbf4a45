"""Templates of shadows on a grid finer than pixels."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.template_from_optics import template_from_optics
from tests.compute.signal.coded_aperture.coded_aperture_scenes import window_optics

POINT = (0.0, 0.0, 2000.0)
ALONG = (2.0, 0.0, 0.0)


def template(**changes):
    given = {"sensor": 0, "direction": ALONG, "per_px": 4, **changes}
    return template_from_optics(window_optics(), changes.pop("point_mm", POINT), **given)


def test_its_cells_are_shadows_of_displaced_points():
    made = template()
    optics = window_optics()
    points = np.array([POINT, (3.7, 0.0, 2000.0)])
    lines = optics.solid_angles(points).solid_angle_sr[:, 0]
    readings = optics.readings(points)[:, 0]
    assert made.reading_px == readings[0]
    np.testing.assert_allclose(made.pixel_values, lines[0][made.first_px :][: made.pixels])
    # Between the cells: another point's shadow, at its own phase.
    shift = readings[1] - readings[0]
    assert abs(shift * 4 - round(shift * 4)) > 0.05
    pixel = np.arange(200, 800)
    value, _, known = made.at(pixel - shift)
    assert known.all()
    assert np.abs(value - lines[1][pixel]).max() < 0.002 * made.height


def test_far_shadows_carry_it_on():
    longer = template(far_px=(-100, 0, 100))
    assert longer.pixels >= template().pixels + 199


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensor": 1}, "sensor is 1; it must be 0 to 0"),
        ({"direction": (0.0, 0.0)}, "direction has the shape"),
        ({"direction": (0.0, 0.0, 0.0)}, "must change"),
        ({"direction": (0.0, 1.0, 0.0)}, "must change"),
        ({"point_mm": (0.0, 0.0, -10.0)}, "must change"),
        # Away along the axis the reading goes to that of the axis, and no further.
        (
            {
                "point_mm": (100.0, 0.0, 2000.0),
                "direction": (0.0, 0.0, 1.0),
                "far_px": (0, -1000, 1000),
            },
            "smaller shifts",
        ),
    ],
)
def test_refusals(changes, words):
    point = changes.pop("point_mm", POINT)
    given = {"sensor": 0, "direction": ALONG, **changes}
    with pytest.raises(InvalidParameter, match=words):
        template_from_optics(window_optics(), point, **given)
