"""Correction tables: splines against SciPy, derivatives, points beyond the box, bad content."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline, RegularGridInterpolator

from compute.errors import InvalidParameter, NonFiniteValue
from compute.mapping.b_splines import b_spline_basis
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import MAX_GROWTH_CELLS, CorrectionTable, Degree

GRID = VoxelGrid((-100.0, 20.0, 1500.0), (50.0, 40.0, 25.0), (4, 3, 5))


def table(degree: Degree, seed: int = 5, **changes: Any) -> CorrectionTable:
    rng = np.random.default_rng(seed)
    content: dict[str, Any] = {
        "coefficients_px": rng.normal(size=(2, 4 + degree, 3 + degree, 5 + degree)),
        "variance_px2": rng.uniform(0.0, 1.0, (2, 5, 4, 6)),
        "valid": rng.random((2, 4, 3, 5)) < 0.7,
    }
    return CorrectionTable(("a", "b"), "0" * 64, GRID, degree, **{**content, **changes})


def points(seed: int, count: int = 50) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.asarray(GRID.origin_mm) + rng.random((count, 3)) * (GRID.end_mm - GRID.origin_mm)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6))
def test_degree_one_is_trilinear_interpolation(seed: int) -> None:
    made, where = table(1, seed), points(seed)
    axes = [
        origin + pitch * np.arange(count + 1)
        for origin, pitch, count in zip(GRID.origin_mm, GRID.pitch_mm, GRID.cells, strict=True)
    ]
    found = made.at(where)
    for sensor in range(2):
        for ours, nodes in (
            (found.value_px, made.coefficients_px),
            (found.variance_px2, made.variance_px2),
        ):
            theirs = RegularGridInterpolator(axes, nodes[sensor])(where)
            assert ours[:, sensor] == pytest.approx(theirs, abs=1e-12)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6))
def test_degree_three_is_the_b_spline_of_scipy(seed: int) -> None:
    made, where = table(3, seed), points(seed)
    knots = tuple(
        origin + pitch * np.arange(-3.0, count + 4.0)
        for origin, pitch, count in zip(GRID.origin_mm, GRID.pitch_mm, GRID.cells, strict=True)
    )
    found = made.at(where)
    for sensor in range(2):
        spline = NdBSpline(knots, made.coefficients_px[sensor], 3)
        assert found.value_px[:, sensor] == pytest.approx(spline(where), abs=1e-12)
        for axis in range(3):
            order = [int(axis == other) for other in range(3)]
            assert found.gradient_px_per_mm[:, sensor, axis] == pytest.approx(
                spline(where, nu=order), abs=1e-12
            )


@pytest.mark.parametrize("degree", [1, 3])
def test_slopes_are_finite_differences(degree: Degree) -> None:
    made, where = table(degree), points(1, 20)
    slope = made.at(where).gradient_px_per_mm
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-4
        rise = (made.at(where + step).value_px - made.at(where - step).value_px) / 2e-4
        assert slope[..., axis] == pytest.approx(rise, abs=1e-6)


@pytest.mark.parametrize("degree", [1, 3])
def test_weights_add_up_to_one(degree: int) -> None:
    weights, slopes = b_spline_basis(np.linspace(0.0, 1.0, 11), degree)
    assert weights.sum(axis=-1) == pytest.approx(1.0)
    assert slopes.sum(axis=-1) == pytest.approx(0.0, abs=1e-15)
    assert (weights >= 0.0).all()


@pytest.mark.parametrize("degree", [1, 3])
def test_beyond_the_box_the_splines_go_on_straight_and_are_marked(degree: Degree) -> None:
    made = table(degree, valid=np.ones((2, 4, 3, 5), dtype=np.bool_))
    beyond = np.array([[-130.0, 60.0, 1540.0], [0.0, 60.0, 1540.0], [120.0, 500.0, 1.0]])
    nearest = np.clip(beyond, GRID.origin_mm, GRID.end_mm)
    found, expected = made.at(beyond), made.at(nearest)
    straight = expected.value_px + np.einsum(
        "nsx,nx->ns", expected.gradient_px_per_mm, beyond - nearest
    )
    # Along one axis; at edges the product of the axes' straight lines is no plane.
    assert found.value_px[:2] == pytest.approx(straight[:2])
    assert found.inside.tolist() == [[False] * 2, [True] * 2, [False] * 2]
    assert found.in_box.tolist() == [False, True, False]
    steps = np.linalg.norm((beyond - nearest) / GRID.pitch_mm, axis=1)
    growth = (1.0 + 0.5 * np.minimum(steps, MAX_GROWTH_CELLS) ** 2) ** 4
    assert found.variance_px2 == pytest.approx(expected.variance_px2 * growth[:, None])


@pytest.mark.parametrize("degree", [1, 3])
def test_beyond_the_box_gradients_are_those_of_the_values(degree: Degree) -> None:
    made, step = table(degree), 1e-4
    low, high = np.asarray(GRID.origin_mm), GRID.end_mm
    anywhere = np.random.default_rng(7).uniform(low - 200.0, high + 200.0, (200, 3))
    # A step across a face between two cells, where splines of degree 1 bend.
    nodes = (anywhere - low) / GRID.pitch_mm
    anywhere = anywhere[(np.abs(nodes - np.rint(nodes)) > 1e-4).all(axis=1)]
    found = made.at(anywhere).gradient_px_per_mm
    for axis in range(3):
        off = step * np.eye(3)[axis]
        numeric = (made.at(anywhere + off).value_px - made.at(anywhere - off).value_px) / (2 * step)
        assert found[..., axis] == pytest.approx(numeric, rel=1e-5, abs=1e-7 * np.abs(found).max())


def test_a_cell_without_measurements_is_not_inside() -> None:
    made = table(3)
    cell, _, _ = GRID.locate(points(2))
    assert (made.at(points(2)).inside == made.valid[:, *cell.T].T).all()


def test_a_point_without_position_has_no_correction() -> None:
    found = table(3).at(np.array([[np.nan, 60.0, 1540.0], [0.0, 60.0, 1540.0]]))
    assert np.isnan(found.value_px[0]).all()
    assert np.isfinite(found.value_px[1]).all()
    assert not found.inside[0].any()


def test_bad_content_is_refused() -> None:
    with pytest.raises(InvalidParameter, match=r"coefficients_px has the shape \(2, 4, 3, 5\)"):
        table(3, coefficients_px=np.zeros((2, 4, 3, 5)))
    holes = np.zeros((2, 7, 6, 8))
    holes[1, 2, 3, 4] = np.nan
    with pytest.raises(NonFiniteValue, match=r"coefficients_px\[1, 2, 3, 4\] is nan"):
        table(3, coefficients_px=holes)
    with pytest.raises(InvalidParameter, match=r"variance_px2\[0, 0, 0, 0\] is -1"):
        table(3, variance_px2=-np.ones((2, 5, 4, 6)))
    with pytest.raises(InvalidParameter, match="degree is 2"):
        table(2)  # type: ignore[arg-type]
    with pytest.raises(InvalidParameter, match="pitch_mm"):
        VoxelGrid((0.0, 0.0, 0.0), (1.0, -1.0, 1.0), (1, 1, 1))
