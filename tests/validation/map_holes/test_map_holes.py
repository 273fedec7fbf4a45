"""Case map-holes: its own cameras and shapes, and a small run."""

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from validation.map_holes.case import run_trial
from validation.map_holes.volumes import (
    CENTRE_MM,
    HALF_MM,
    LAYOUTS,
    SHAPES,
    cameras,
    places,
    random_hole,
    read,
)


def test_own_projection_is_that_of_the_cameras():
    points = CENTRE_MM + HALF_MM * np.random.default_rng(1).uniform(-1.0, 1.0, (50, 3))
    np.testing.assert_allclose(read(points), CameraStack.of(cameras()).project(points))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_fill_the_box(layout):
    unit = places(layout, 400, np.random.default_rng(2))
    assert 250 < len(unit) < 550
    assert 0.9 < np.abs(unit).max() <= 1.0
    for axis in range(3):
        assert np.ptp(unit[:, axis]) > 1.8


@pytest.mark.parametrize("shape", SHAPES)
def test_holes_hold_part_of_the_box(shape):
    rng = np.random.default_rng(3)
    unit = rng.uniform(-1.0, 1.0, (20_000, 3))
    small, large = (
        np.mean([random_hole(shape, size, rng).contains(unit).mean() for _ in range(5)])
        for size in (0.4, 0.8)
    )
    assert 0.005 < small < large < 0.7


@pytest.mark.slow
def test_a_sphere_without_measurements_is_not_supported_and_a_wide_feature_is_mapped():
    found = run_trial("jittered", "sphere", np.random.default_rng([1, 5]))
    assert not np.isfinite(found.error_sigma[found.in_hole]).any()
    assert found.hidden_px.max() > 0.05
    assert np.isfinite(found.error_sigma).mean() > 0.2
    assert (found.largest_feature[found.width >= 1.0] < 3.0).all()
