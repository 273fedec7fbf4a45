import numpy as np
import pytest

from compute.errors import (
    DegeneratePoints,
    DuplicatePoint,
    InvalidParameter,
    NonFiniteValue,
    ReadingOutsideSensor,
    TooFewPoints,
)
from compute.mapping.build import build_table
from compute.mapping.cell_support import check_supported
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.result import MappingSettings
from tests.compute.mapping.scenes import SIGMA, calibrated, exact, lattice, measured, places, truth

FIXED = MappingSettings(penalty_weight=1.0)


@pytest.fixture(scope="module")
def control():
    return measured(places(60, 1))


@pytest.fixture(scope="module")
def models(control):
    return calibrated(control).models


def changed(control, *, points=None, readings=None, sigma=None, spread=0.0):
    return MappingMeasurements(
        control.points_mm if points is None else points,
        control.readings_px if readings is None else readings,
        control.sigma_px if sigma is None else sigma,
        spread,
    )


def refused(error, words, models, what, settings=FIXED):
    with pytest.raises(error, match=words):
        build_table(models, "", what, settings=settings)


def test_wrong_shapes(control, models):
    refused(
        InvalidParameter, r"\(60, 2\); it must", models, changed(control, points=np.ones((60, 2)))
    )
    refused(
        InvalidParameter,
        r"\(60, 2\); 60 points and 3 sensors make \(60, 3\)",
        models,
        changed(control, readings=control.readings_px[:, :2]),
    )
    refused(
        InvalidParameter,
        r"sigma_px has the shape \(3,\)",
        models,
        changed(control, sigma=np.full(3, SIGMA)),
    )


def test_values_that_are_none(control, models):
    points = control.points_mm.copy()
    points[4, 2] = np.nan
    refused(NonFiniteValue, "point 5 has Z = nan", models, changed(control, points=points))
    readings = control.readings_px.copy()
    readings[3, 1] = np.inf
    refused(NonFiniteValue, "point 4 by sensor s2", models, changed(control, readings=readings))
    sigma = control.sigma_px.copy()
    sigma[2, 0] = 0.0
    refused(InvalidParameter, "point 3 by sensor s1 is 0.0", models, changed(control, sigma=sigma))
    refused(InvalidParameter, "position_sigma_mm is -1", models, changed(control, spread=-1.0))


def test_a_reading_beyond_the_pixels(control, models):
    readings = control.readings_px.copy()
    readings[7, 2] = 2048.0
    refused(
        ReadingOutsideSensor,
        "point 8 lies outside sensor s3",
        models,
        changed(control, readings=readings),
    )


def test_a_place_given_twice(control, models):
    points = control.points_mm.copy()
    points[9] = points[2]
    refused(DuplicatePoint, "points 3 and 10", models, changed(control, points=points))


def test_too_few_points(control, models):
    readings = control.readings_px.copy()
    readings[5:, 1] = np.nan
    refused(TooFewPoints, "sensor s2 saw 5", models, changed(control, readings=readings))
    refused(TooFewPoints, "sensor s1 saw 7", models, measured(places(7, 1)))
    # Ten parameters each: distortion of two terms and the place along the slit.
    refused(TooFewPoints, "10 parameters.*give at least 11", truth(), measured(places(10, 1)))
    none = MappingMeasurements(np.empty((0, 3)), np.empty((0, 3)))
    refused(TooFewPoints, "saw 0", models, none)


def test_points_in_one_plane(control, models):
    points = control.points_mm.copy()
    points[:, 2] = 1500.0
    flat = changed(control, points=points, readings=exact(truth(), points))
    refused(DegeneratePoints, "in one plane", models, flat)


def test_one_sided_coverage(models):
    control = measured(places(400, 3))
    readings = control.readings_px.copy()
    readings[control.points_mm[:, 0] < 230.0, 1] = np.nan
    refused(
        DegeneratePoints,
        "sensor s2 saw points on one side",
        models,
        changed(control, readings=readings),
    )


def test_no_supported_cell():
    valid = np.zeros((5, 5, 5), dtype=bool)
    with pytest.raises(TooFewPoints, match="no cell of the grid has enough of sensor s1's"):
        check_supported(valid, "s1")
    valid[2, 3, 1] = True
    check_supported(valid, "s1")


def test_a_missing_node_inside_the_grid(models):
    points = lattice((6, 6, 5))
    control = measured(points)
    readings = control.readings_px.copy()
    readings[2 * 30 + 3 * 5 + 2, 0] = np.nan
    holed = changed(control, readings=readings)
    result = build_table(models, "", holed, settings=MappingSettings(method="trilinear"))
    invalid = np.argwhere(~result.table.valid)
    assert invalid.tolist() == [[0, x, y, z] for x in (1, 2) for y in (2, 3) for z in (1, 2)]
    assert result.validation.sensors[0].coverage == "measurements support 92 % of the volume"


def test_interpolation_needs_a_grid_and_the_noise(control, models):
    settings = MappingSettings(method="tricubic")
    refused(InvalidParameter, "not equally spaced", models, control, settings)
    points = lattice((3, 3, 3))
    unknown = MappingMeasurements(points, exact(truth(), points))
    refused(InvalidParameter, "give sigma_px", models, unknown, settings)


def test_a_calibration_of_another_frame(control, models):
    behind = changed(control, points=control.points_mm - [0.0, 0.0, 3000.0])
    refused(InvalidParameter, "behind whose lens", models, behind)


def test_more_cells_than_can_be_held(control, models):
    settings = MappingSettings(pitch_mm=(1.0, 1.0, 1.0))
    refused(InvalidParameter, "at most 200000", models, control, settings)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"method": "spline"}, 'method is "spline"'),
        ({"pitch_mm": (1.0, 0.0, 1.0)}, "pitch_mm is"),
        ({"pitch_mm": (9.0, 9.0, 9.0), "method": "trilinear"}, "leave it out"),
        ({"penalty_weight": 0.0}, "penalty_weight is 0.0"),
        ({"penalty_weight": 1.0, "method": "tricubic"}, "leave it out"),
        ({"min_neighbours": 0}, "min_neighbours is 0"),
    ],
)
def test_settings_that_mean_nothing(given, words):
    with pytest.raises(InvalidParameter, match=words):
        MappingSettings(**given)
