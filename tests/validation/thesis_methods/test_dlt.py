"""Conversions between the metric camera and its other forms."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from tests.compute.camera.test_projection import assert_same, floats, models, readings, scene
from validation.thesis_methods.dlt import (
    CollinearityParameters,
    collinearity_parameters_of,
    dlt_parameters_of,
    model_from_collinearity,
    model_from_matrix,
)

GEOMETRY = SensorGeometry("s", 2048)
Array = NDArray[np.float64]


@given(models())
def test_matrix_round_trip_in_any_scale_and_sign(model: SensorModel) -> None:
    points, matrix = scene(model), CameraStack.of([model]).matrices[0]
    for scale in (1.0, -3.7, 1e-4):
        back = model_from_matrix(matrix * scale, GEOMETRY, points[0])
        assert_same(back, model)


@given(models())
def test_dlt_round_trip(model: SensorModel) -> None:
    assume(abs(model.offset_z_mm) > 1.0)
    points = scene(model)
    parameters = dlt_parameters_of(model)
    homogeneous = np.column_stack([points, np.ones(len(points))])
    by_dlt = (homogeneous @ parameters[:4]) / (points @ parameters[4:] + 1.0)
    assert np.allclose(by_dlt, readings(model, points), rtol=0, atol=1e-5)
    matrix = np.append(parameters, 1.0).reshape(2, 4)
    assert_same(model_from_matrix(matrix, GEOMETRY, points[0]), model, 1e-6)


def test_dlt_needs_an_origin_off_the_lens_plane() -> None:
    model = SensorModel("s", 2048, 3000.0, 1000.0, (0.1, 0.2, 0.3), 5.0, 0.0)
    with pytest.raises(InvalidParameter, match="move the origin"):
        dlt_parameters_of(model)


@given(
    models(), floats(0.1, 10.0), floats(0.1, 10.0), floats(-3.0, 3.0), floats(-900.0, 900.0),
    st.booleans(),
)  # fmt: skip
def test_collinearity_form_in_any_gauge(
    model: SensorModel, common: float, along: float, mixed: float, shift: float, flip: bool
) -> None:
    """The four free directions of the eleven coefficients change nothing (DESIGN: the model)."""
    points = scene(model)
    canonical = collinearity_parameters_of(model)
    assert_same(model_from_collinearity(canonical, GEOMETRY), model)

    l_row, m_row = np.array(canonical.along), np.array(canonical.axis)
    sign = -1.0 if flip else 1.0
    # -(p - p0)/c = l.d / m.d: adding k m to l shifts q by k and p0 by c k.
    l_new = (l_row + mixed * m_row) * along
    gauge = CollinearityParameters(
        canonical.c / along,
        canonical.p0 + canonical.c * mixed,
        tuple(np.array(canonical.centre_mm) + shift * np.cross(l_row, m_row)),
        tuple(l_new * common * sign),
        tuple(m_row * common * sign),
    )
    relative = points - np.array(gauge.centre_mm)
    q = (relative @ np.array(gauge.along)) / (relative @ np.array(gauge.axis))
    assert np.allclose(gauge.p0 - gauge.c * q, readings(model, points), rtol=0, atol=1e-5)
    assert_same(model_from_collinearity(gauge, GEOMETRY, points[0]), model, 1e-6)


def test_readings_in_mm_become_pixels() -> None:
    parameters = CollinearityParameters(37.0, 12.29, (0, 0, 0), (1, 0, 0), (0, 0, 1))
    pixels = parameters.in_pixels(0.012)
    assert pixels.c == pytest.approx(37.0 / 0.012)
    # The sensor's edge is half a pixel before the centre of the first one.
    assert pixels.p0 == pytest.approx(12.29 / 0.012 - 0.5)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((2, 4)),
        np.array([[1.0, 2, 3, 4], [2, 4, 6, 1]]),
        np.array([[np.nan, 0, 0, 1], [0, 0, 1, 1]]),
    ],
    ids=["zero", "parallel", "nan"],
)
def test_no_camera_has_such_a_matrix(matrix: Array) -> None:
    with pytest.raises(InvalidParameter, match="sensor s"):
        model_from_matrix(matrix, GEOMETRY)
