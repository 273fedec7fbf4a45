"""Tables against the exact rays that they stand for."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.optics.profiles.profile_loader import load_profile
from compute.optics.profiles.profile_optics import (
    lens_sensors,
    light_source,
    pixel_row,
    profile_field,
)
from compute.optics.sensor_placement import place_optics
from compute.optics.stripe_optics.stripe_profile import Blur
from compute.optics.stripe_optics.stripe_table import FieldOfView, TableNodes
from compute.optics.stripe_optics.tabulated_optics import TabulatedOptics
from compute.optics.stripe_optics.traced_stripes import ExactOptics
from tests.compute.optics.stripe_optics.optical_systems import ROW, TILTED

BLUR = Blur(880.0, 0.3)


def centroids(solid_angles):
    window = solid_angles.solid_angle_sr
    light = window.sum(axis=2)
    moment = (window * np.arange(window.shape[2])).sum(axis=2)
    return solid_angles.first_px + moment / np.where(light > 0.0, light, np.nan), light


def one_sensor(assembly, row=ROW):
    return place_optics(
        "one",
        position_mm=(0.0, 0.0, 0.0),
        aim_mm=(0.0, 0.0, 1000.0),
        measured_direction=(1.0, 0.0, 0.0),
        assembly=assembly,
        row=row,
    )


@pytest.fixture(scope="module")
def bar():
    profile = load_profile("bar")
    source = light_source(profile)
    sensors = lens_sensors(profile, pixel_row(profile))
    blur = Blur(source.wavelength_nm, source.width_mm)
    tables = TabulatedOptics(sensors, blur, profile_field(profile, sensors))
    return profile, tables, ExactOptics(sensors, blur)


@pytest.mark.slow
def test_tables_of_the_bar_over_its_volume(bar):
    profile, tables, exact = bar
    rng = np.random.default_rng(20)
    points = np.array(profile.volume.centre_mm) + profile.volume.size_mm * (
        rng.random((1000, 3)) - 0.5
    )
    ours, light = centroids(tables.solid_angles(points))
    traced, traced_light = centroids(exact.solid_angles(points))
    assert (traced_light > 0.0).all()
    assert np.percentile(np.abs(ours - traced), 99.9) <= 0.005
    np.testing.assert_allclose(light, traced_light, rtol=1e-3)


@pytest.mark.slow
def test_points_outside_of_the_field_are_traced(bar):
    _, tables, exact = bar
    points = np.array([[0.0, 0.0, 400.0], [0.0, 900.0, 1500.0], [0.0, 0.0, 9000.0]])
    ours, light = centroids(tables.solid_angles(points))
    traced, traced_light = centroids(exact.solid_angles(points))
    np.testing.assert_array_equal(light > 0.0, traced_light > 0.0)
    lit = traced_light > 0.0
    assert lit.sum() >= 8
    # They differ by the rays of a fan and by the pieces between quantiles.
    assert np.abs(ours - traced)[lit].max() < 0.005
    np.testing.assert_allclose(light[lit], traced_light[lit], rtol=1e-5)


@pytest.mark.slow
def test_dark_is_dark_and_behind_too(bar):
    _, tables, _ = bar
    points = np.array([[2500.0, 0.0, 1500.0], [0.0, 0.0, -1500.0]])
    found = tables.solid_angles(points).solid_angle_sr
    assert not found.any()


def beside(optics_field, nodes, ends, count, seed):
    """Tables and exact rays of the tilted lens at random points of part of the field."""
    sensor = one_sensor(TILTED)
    tables = TabulatedOptics([sensor], BLUR, optics_field, nodes)
    rng = np.random.default_rng(seed)
    u, v, z = (rng.uniform(low, high, count) for low, high in ends)
    points = np.column_stack([u * z, v * z, z])
    return (
        *centroids(tables.solid_angles(points)),
        *centroids(ExactOptics([sensor], BLUR).solid_angles(points)),
    )


@pytest.mark.slow
def test_tables_of_tilted_optics():
    field = FieldOfView((0.0, 0.1), (-0.04, 0.04), (1200.0, 1500.0))
    ends = (field.u, field.v, field.distance_mm)
    ours, light, traced, traced_light = beside(field, TableNodes(15, 6, 4), ends, 300, 3)
    assert (traced_light > 0.0).all()
    assert np.percentile(np.abs(ours - traced), 99.9) <= 0.005
    np.testing.assert_allclose(light, traced_light, rtol=1e-3)


@pytest.mark.slow
def test_cells_at_the_edge_of_the_light():
    """Beyond the row's end lines go dark: what the table cannot say there is traced."""
    field = FieldOfView((0.3, 0.45), (-0.04, 0.04), (1200.0, 1500.0))
    ends = (field.u, field.v, field.distance_mm)
    ours, light, traced, traced_light = beside(field, TableNodes(15, 6, 4), ends, 200, 4)
    np.testing.assert_array_equal(light > 0.0, traced_light > 0.0)
    lit = traced_light > 0.0
    assert 20 < lit.sum() < 180
    assert not light[~lit].any()
    # Cells here are wide; what is said is that no line is made up, lost, or misplaced.
    assert np.abs(ours - traced)[lit].max() < 0.1
    np.testing.assert_allclose(light[lit], traced_light[lit], rtol=0.01)


def test_a_kind_is_tabulated_once():
    sensor = one_sensor(TILTED)
    field = FieldOfView((-0.02, 0.02), (-0.02, 0.02), (1000.0, 1100.0))
    first, second = (TabulatedOptics([sensor], BLUR, field, TableNodes(7, 4, 4)) for _ in range(2))
    kind = (sensor.assembly, sensor.row)
    assert first._tables[kind] is second._tables[kind]


@pytest.mark.parametrize(
    ("field", "match"),
    [
        (((0.1, 0.1), (0.0, 0.1), (1.0, 2.0)), "u is 0.1 to 0.1"),
        (((0.0, 0.1), (0.0, np.inf), (1.0, 2.0)), "v is 0.0 to inf"),
        (((0.0, 0.1), (0.0, 0.1), (0.0, 2.0)), "distance_mm begins at 0.0"),
    ],
)
def test_fields_are_refused(field, match):
    with pytest.raises(InvalidParameter, match=match):
        FieldOfView(*field)
