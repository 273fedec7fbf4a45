"""Distortion over both field angles: terms, slopes, inverse, and fits of camera and terms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from compute.camera.field_distortion import (
    DEGENERATE,
    all_terms,
    check_terms,
    power_terms,
    symmetric_terms,
    term_derivatives,
    term_values,
)
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, InvalidParameter, TooFewPoints
from validation.skew_effect.field_distortion_fit import FieldModel, fit_field_model

RNG = np.random.default_rng(5)
TERMS = symmetric_terms(5)
MODEL = FieldModel(
    2700.0,
    1020.0,
    (0.02, -0.03, 0.01),
    (4.0, 2.0, -3.0),
    TERMS,
    (0.12, -0.2, -0.3, 0.1, 0.05),
    33.0,
)


def points(count: int) -> np.ndarray:
    u, v = RNG.uniform(-0.36, 0.36, (2, count))
    z = RNG.uniform(1000.0, 2000.0, count)
    return np.stack([u * z, v * z, z], axis=1)


def test_terms() -> None:
    assert power_terms(7, odd_only=True) == ((3, 0), (5, 0), (7, 0))
    assert power_terms(5, odd_only=False) == ((3, 0), (4, 0), (5, 0))
    assert symmetric_terms(3) == ((1, 2), (3, 0))
    assert len(all_terms(5)) == 21 - len(DEGENERATE)
    assert not set(all_terms(7)) & set(DEGENERATE)


@pytest.mark.parametrize("term", DEGENERATE)
def test_degenerate_terms_are_refused(term: tuple[int, int]) -> None:
    with pytest.raises(InvalidParameter, match=f"degenerate with {DEGENERATE[term]}"):
        check_terms([(3, 0), term])


@pytest.mark.parametrize("term", [(-1, 2), (3, 0)])
def test_wrong_terms_are_refused(term: tuple[int, int]) -> None:
    with pytest.raises(InvalidParameter, match="at index 1"):
        check_terms([(3, 0), term])


@pytest.mark.parametrize("term", DEGENERATE)
def test_they_are_degenerate(term: tuple[int, int]) -> None:
    """A camera's own slopes span them where the points are far: that is why they are refused."""
    u, v = (g.ravel() for g in np.meshgrid(*[np.linspace(-0.35, 0.35, 9)] * 2))
    far = 1e6 * np.stack([u, v, np.ones_like(u)], axis=1)
    slopes = FieldModel(2700.0, 1023.5).linearised(far)[1][:, :5]

    def left(of: tuple[int, int]) -> float:
        wanted = term_values(u, v, [of])[:, 0]
        scaled = slopes / np.linalg.norm(slopes, axis=0)
        if of == (2, 0):
            scaled = np.column_stack([scaled, np.ones_like(u)])
        found = np.linalg.lstsq(scaled, wanted, rcond=None)[0]
        return float(np.linalg.norm(wanted - scaled @ found) / np.linalg.norm(wanted))

    assert left(term) < 1e-9
    assert left((1, 2)) > 1e-2
    assert left((3, 0)) > 1e-2


@given(u=st.floats(-0.4, 0.4), v=st.floats(-0.4, 0.4))
def test_slopes_of_terms(u: float, v: float) -> None:
    step = 1e-6
    terms = all_terms(7)
    by_u, by_v = term_derivatives(np.array([u]), np.array([v]), terms)
    for slope, du, dv in ((by_u, step, 0.0), (by_v, 0.0, step)):
        ahead = term_values(np.array([u + du]), np.array([v + dv]), terms)
        behind = term_values(np.array([u - du]), np.array([v - dv]), terms)
        assert slope == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-9)


def test_without_terms_it_is_the_camera() -> None:
    """The camera of compute.camera, readings and slopes, wherever the row is."""
    seen = points(50)
    turn = (0.02, -0.03, 0.01)
    camera = SensorModel("one", 2048, 2700.0, 1020.0, turn, 4.0, -3.0)
    ours = FieldModel(2700.0, 1020.0, turn, (4.0, 2.0, -3.0), row_behind_mm=33.0)
    readings, slopes = ours.linearised(seen)
    cameras = CameraStack.of([camera])
    assert readings == pytest.approx(cameras.project(seen)[:, 0], rel=1e-13)
    assert slopes == pytest.approx(cameras.parameter_jacobian(seen)[:, 0], rel=1e-9, abs=1e-12)


def test_slopes_of_readings() -> None:
    """Against differences of moved models, the rotation a left one in the sensor's frame."""
    seen, step = points(20), 1e-5
    _, slopes = MODEL.linearised(seen)
    moves = np.eye(7 + len(TERMS)) * step
    for column, move in enumerate(moves):
        ahead, behind = (moved(MODEL, sign * move).readings_px(seen) for sign in (1.0, -1.0))
        assert slopes[:, column] == pytest.approx(
            (ahead - behind) / (2.0 * step), rel=1e-6, abs=1e-5
        )


def moved(model: FieldModel, step: np.ndarray) -> FieldModel:
    turn = Rotation.from_rotvec(step[2:5]) * Rotation.from_rotvec(model.rotation_vector_rad)
    rotated = turn.as_rotvec()
    x, y, z = model.offset_mm
    return replace(
        model,
        principal_distance_px=model.principal_distance_px + step[0],
        principal_point_px=model.principal_point_px + step[1],
        rotation_vector_rad=(rotated[0], rotated[1], rotated[2]),
        offset_mm=(x + step[5], y, z + step[6]),
        coefficients=tuple(np.array(model.coefficients) + step[7:]),
    )


def test_a_known_model_is_found_again() -> None:
    seen, other = points(300), points(100)
    fit = fit_field_model(
        seen,
        MODEL.readings_px(seen),
        FieldModel(2600.0, 1000.0, (0.0, 0.0, 0.0), (0.0, 2.0, 0.0), row_behind_mm=33.0),
        TERMS,
    )
    assert fit.max_px < 1e-8
    assert fit.model.readings_px(other) == pytest.approx(MODEL.readings_px(other), abs=1e-7)
    assert fit.model.coefficients == pytest.approx(MODEL.coefficients, abs=1e-7)
    assert fit.model.rotation_vector_rad == pytest.approx(MODEL.rotation_vector_rad, abs=1e-9)


def test_a_fit_settles_where_no_term_follows_the_readings() -> None:
    """Readings with kinks, as of lines that an edge cuts: it ends in a minimum all the same."""
    axes = np.linspace(0.0, 500.0, 5), np.linspace(-400.0, 100.0, 5), np.linspace(1500, 2000, 5)
    seen = np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1)
    u, v = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
    kinks = np.maximum(u + 0.5 * v**2 - 0.2, 0.0) - np.abs(u + v - 0.1)
    readings = FieldModel(3000.0, 1023.5, row_behind_mm=36.0).readings_px(seen) + 100.0 * kinks
    start = FieldModel(2900.0, 1023.5, row_behind_mm=36.0)
    fit = fit_field_model(seen, readings, start, all_terms(5))
    slopes = fit.model.linearised(seen)[1]
    explained = fit.residuals_px @ slopes / np.linalg.norm(slopes, axis=0)
    assert np.abs(explained).max() < 1e-4 * np.linalg.norm(fit.residuals_px)
    assert 0.5 < fit.rms_px < 1.0


def test_what_a_fit_refuses() -> None:
    seen = points(300)
    readings = MODEL.readings_px(seen)
    with pytest.raises(TooFewPoints, match="10 points for 12 parameters"):
        fit_field_model(seen[:10], readings[:10], MODEL, TERMS)
    same = seen * (1500.0 / seen[:, 2:])
    with pytest.raises(DegeneratePoints, match="at other distances"):
        fit_field_model(same, MODEL.readings_px(same), FieldModel(2700.0, 1020.0), ())
