"""Coverage: shares of a volume by hand and by geometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.planning.coverage import Box, coverage, is_visible, volume_grid
from tests.compute.rig import camera

BOX = Box((0.0, 0.0, 1500.0), (400.0, 200.0, 600.0))


@given(st.tuples(*(st.integers(2, 7) for _ in range(3))))
def test_the_lattice_covers_the_box(points: tuple[int, int, int]) -> None:
    grid = volume_grid(BOX, points)
    assert len(grid.points_mm) == len(grid.weights) == np.prod(points)
    assert grid.weights.sum() == pytest.approx(1.0)
    assert BOX.contains(grid.points_mm).all()
    np.testing.assert_allclose(grid.points_mm.max(axis=0), [200.0, 100.0, 1800.0])
    np.testing.assert_allclose(grid.points_mm.min(axis=0), [-200.0, -100.0, 1200.0])
    # The trapezoidal rule is exact for what is linear along each axis.
    x, y, z = grid.points_mm.T
    assert grid.weights @ (2.0 + x + y * z) == pytest.approx(2.0)
    if all(count % 2 for count in points):
        assert (grid.points_mm == BOX.centre_mm).all(axis=1).any()


def test_shares_by_hand() -> None:
    visible = np.array([[1, 1, 1, 1], [1, 1, 1, 0], [1, 0, 0, 0], [0, 0, 0, 0]], dtype=bool)
    found = coverage(visible, np.array([0.1, 0.2, 0.3, 0.4]))
    assert found.by_count == pytest.approx((0.4, 0.3, 0.0, 0.2, 0.1))
    assert found.by_sensor == pytest.approx((0.6, 0.3, 0.3, 0.1))
    assert found.all_sensors == pytest.approx(0.1)
    assert found.three_or_more == pytest.approx(0.3)


def test_a_field_of_view_cuts_the_volume_where_geometry_says() -> None:
    """A sensor that reads along x, from the origin: |x| <= z pixels / 2 c."""
    model = camera("s", np.zeros(3), 0.0, np.array([0.0, 0.0, 1500.0]))
    half_tangent = 1024.0 / 3000.0
    box = Box((0.0, 0.0, 1500.0), (2000.0, 100.0, 400.0))
    grid = volume_grid(box, (801, 2, 41))
    position = CameraStack.of([model]).project(grid.points_mm)
    visible = is_visible(position, 2048, np.ones_like(position))
    x, _, z = grid.points_mm.T
    assert (visible[:, 0] == (np.abs(x) <= half_tangent * z + 1e-9)).all()
    # At 1500 mm, the mean distance, 2 x 512 mm of 2000 mm; a step of the grid is 2.5 mm.
    assert coverage(visible, grid.weights).all_sensors == pytest.approx(0.512, abs=0.002)


def test_no_light_is_not_seen() -> None:
    position = np.array([[0.0, 10.0, np.nan, -0.6, 2047.5, 2047.6]])
    light = np.array([[1.0, 0.0, 1.0, 1.0, 1.0, 1.0]])
    assert is_visible(position, 2048, light).tolist() == [[True, False, False, False, True, False]]


@pytest.mark.parametrize("points", [(1, 3, 3), (3, 3, 0), (100, 100, 11)])
def test_grids_that_are_refused(points: tuple[int, int, int]) -> None:
    with pytest.raises(InvalidParameter, match="grid"):
        volume_grid(BOX, points)


@pytest.mark.parametrize("size", [(0.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, float("nan"))])
def test_boxes_that_are_refused(size: tuple[float, float, float]) -> None:
    with pytest.raises(InvalidParameter, match="size_mm"):
        Box((0.0, 0.0, 0.0), size)


def test_nan_is_outside() -> None:
    assert not BOX.contains(np.array([np.nan, 0.0, 1500.0]))
    assert BOX.uniform(50, np.random.default_rng(1)).shape == (50, 3)
    assert BOX.contains(BOX.uniform(50, np.random.default_rng(1))).all()
