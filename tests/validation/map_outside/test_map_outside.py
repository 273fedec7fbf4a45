"""Case map-outside: its own cameras, distances and errors, and small runs."""

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from validation.map_outside.case import run_trial
from validation.map_outside.rigs import (
    KINDS,
    PRINCIPAL_PX,
    REGIONS,
    normalised_errors,
    random_field,
    random_rig,
    random_scene,
)


def test_own_projection_is_that_of_the_cameras():
    rng = np.random.default_rng(1)
    rig = random_rig(rng)
    points = rig.centre_mm + rig.half_mm * rng.uniform(-1.5, 1.5, (50, 3))
    u, _ = rig.field_angles(points)
    read = PRINCIPAL_PX + rig.principal_distance_px * u
    np.testing.assert_allclose(read, CameraStack.of(rig.models).project(points))


@pytest.mark.parametrize("kind", KINDS)
def test_fields_are_smooth_and_as_large_as_they_say(kind):
    rng = np.random.default_rng(2)
    rig = random_rig(rng)
    points = rig.centre_mm + rig.half_mm * rng.uniform(-1.0, 1.0, (500, 3))
    largest = np.abs(random_field(kind, rig, rng).at(points)).max()
    assert largest == 0.0 if kind == "none" else 0.1 < largest < 200.0


@pytest.mark.parametrize("region", REGIONS)
def test_distances_are_those_from_the_hull(region):
    scene = random_scene("none", region, np.random.default_rng(3))
    low, high = scene.points_mm.min(axis=0), scene.points_mm.max(axis=0)
    away = np.maximum(np.maximum(low - scene.probes_mm, scene.probes_mm - high), 0.0)
    # The hull lies in the box.
    outside = np.maximum(scene.distance_mm, 0.0)
    assert (outside >= np.linalg.norm(away, axis=1) - 1e-9).all()
    assert (scene.distance_mm < 0.0).any()


def test_normalised_errors_of_normal_draws_are_three():
    rng = np.random.default_rng(4)
    half = rng.standard_normal((3, 3))
    error = rng.standard_normal((20_000, 3)) @ half.T
    covariance = np.broadcast_to(half @ half.T, (20_000, 3, 3))
    assert normalised_errors(error, covariance).mean() == pytest.approx(3.0, abs=0.1)


def test_errors_outside_are_as_large_as_stated_and_beyond_nothing_is_stated():
    found = run_trial(random_scene("lens", "box", np.random.default_rng([1, 0])))
    outside = [one.nees for name, one in found.classes.items() if name.endswith("mm outside")]
    assert len(outside) == 6
    assert max(outside) < 5.0
    assert found.stated_beyond == 0
    assert found.lost == 0.0


@pytest.mark.slow
def test_normalised_errors_are_near_three_in_every_class_of_many_rigs():
    trials = [
        run_trial(random_scene(kind, region, np.random.default_rng([2, number])))
        for number, (kind, region) in enumerate((k, r) for r in REGIONS for k in KINDS)
    ]
    for name in ("0 to 15 mm outside", "30 to 60 mm outside", "60 to 100 mm outside"):
        nees = [one.classes[name].nees for one in trials if name in one.classes]
        assert 2.2 < np.median(nees) < 3.8, name
        assert np.mean(np.array(nees) < 5.0) > 0.8, name
    assert not sum(one.stated_beyond for one in trials)
