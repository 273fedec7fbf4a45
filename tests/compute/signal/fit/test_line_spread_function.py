"""Line shapes: the Gaussian's table, measured shapes, nodes along the sensor."""

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import norm

from compute.errors import InvalidParameter
from compute.signal.fit.line_spread_function import LineSpreadFunction


def test_the_gaussian_is_as_good_as_it_says():
    t = np.linspace(-8.0, 8.0, 4001)
    edge, slope = LineSpreadFunction.gaussian().at(t)
    assert np.abs(edge - ndtr(t)).max() < 1e-7
    assert np.abs(slope - norm.pdf(t)).max() < 2e-6


def test_slopes_are_the_edges_derivatives():
    rng = np.random.default_rng(1)
    shape = LineSpreadFunction.from_cells(rng.uniform(0.5, 1.0, 40), -1.25, 1.0 / 16.0)
    t = rng.uniform(-1.3, 1.3, 501)
    step = 1e-6
    numeric = (shape.at(t + step)[0] - shape.at(t - step)[0]) / (2.0 * step)
    # At a place of the table the second derivative jumps.
    between = np.abs((t - shape.first) / shape.step % 1.0 - 0.5) < 0.499
    np.testing.assert_allclose(shape.at(t)[1][between], numeric[between], atol=1e-8)
    assert (shape.at(t)[1][(t < -1.25) | (t > 1.25)] == 0.0).all()


def test_a_measured_gaussian_is_the_gaussian_in_units_of_its_width():
    step, width = 1.0 / 16.0, 1.3
    edges = np.arange(-128, 129) * step
    shape = LineSpreadFunction.from_cells(
        np.diff(ndtr(edges / width)), edges[0], step, unit_px=width
    )
    t = np.linspace(-5.0, 5.0, 501)
    np.testing.assert_allclose(shape.at(t)[0], ndtr(t), atol=1e-6)
    np.testing.assert_allclose(shape.at(t)[1], norm.pdf(t), atol=3e-4)
    assert shape.reach == pytest.approx(8.0 / width)


def test_between_nodes_both_count_by_distance_and_each_sensor_has_its_own():
    cells = np.zeros((2, 3, 8))
    for sensor in range(2):
        for node in range(3):
            cells[sensor, node, 1 + node + sensor] = 1.0
    shape = LineSpreadFunction.from_cells(
        cells, -0.5, 0.125, first_node_px=100.0, node_step_px=50.0
    )
    t = np.linspace(-0.6, 0.6, 25)
    for sensor in range(2):
        nodes = [shape.at(t, sensor, 100.0 + 50.0 * node)[0] for node in range(3)]
        quarter = shape.at(t, sensor, 112.5)[0]
        np.testing.assert_allclose(quarter, 0.75 * nodes[0] + 0.25 * nodes[1], atol=1e-15)
        for beyond, node in ((-1000.0, 0), (1000.0, 2)):
            np.testing.assert_array_equal(shape.at(t, sensor, beyond)[0], nodes[node])
    many = shape.at(t[:, None], [0, 1], [112.5, 160.0])
    one = [shape.at(t, 0, 112.5), shape.at(t, 1, 160.0)]
    for k in range(2):
        np.testing.assert_array_equal(many[0][:, k], one[k][0])
        np.testing.assert_array_equal(many[1][:, k], one[k][1])


def test_lines_along_a_sensor_give_shapes_by_place():
    """Gaussians that become wider along the sensor, on cells of 1/16 px at any fraction."""
    place = np.array([400.37, 100.0, 250.61])
    width = 1.0 + place / 400.0
    first = np.floor(place).astype(int) - 30
    edges = first[:, None] - 0.5 + np.arange(60 * 16 + 1) / 16
    light = np.diff(ndtr((edges - place[:, None]) / width[:, None]), axis=1)
    shape = LineSpreadFunction.from_lines(
        light * [[3.0], [1.0], [2.0]], first, place, 16, unit_px=2.0
    )
    assert shape.cumulative.shape[:2] == (1, 3)
    t = np.linspace(-4.0, 4.0, 161)
    for at, own in zip(place[:2], width[:2], strict=True):
        np.testing.assert_allclose(shape.at(t, 0, at)[0], ndtr(t * 2.0 / own), atol=2e-4)
        np.testing.assert_allclose(
            shape.at(t, 0, at)[1], norm.pdf(t * 2.0 / own) * 2.0 / own, atol=2e-3
        )
    middle = shape.at(t, 0, 0.5 * (100.0 + 400.37))[0]
    low, high = ndtr(t * 2.0 / width[1]), ndtr(t * 2.0 / width[2])
    assert ((middle - low) * (middle - high) <= 1e-4).all()


@pytest.mark.parametrize(
    "make",
    [
        lambda: LineSpreadFunction.from_cells([1.0, 1.0], 0.0, 0.1),
        lambda: LineSpreadFunction.from_cells([1.0, -1.0, 1.0], 0.0, 0.1),
        lambda: LineSpreadFunction.from_cells([0.0, 0.0, 0.0], 0.0, 0.1),
        lambda: LineSpreadFunction.from_cells([1.0, np.nan, 1.0], 0.0, 0.1),
        lambda: LineSpreadFunction.from_cells([1.0, 1.0, 1.0], 0.0, 0.0),
        lambda: LineSpreadFunction.from_cells([1.0, 1.0, 1.0], 0.0, 0.1, unit_px=0.0),
        lambda: LineSpreadFunction.from_cells([1.0, 1.0, 1.0], 0.0, 0.1, node_step_px=0.0),
        lambda: LineSpreadFunction.from_lines(np.ones((2, 8)), [0, 0], [3.0, 3.0], 4),
        lambda: LineSpreadFunction.from_lines(np.ones((2, 8)), [0, 0], [3.0, np.nan], 4),
        lambda: LineSpreadFunction.from_lines(np.ones((2, 8)), [0], [3.0, 4.0], 4),
        lambda: LineSpreadFunction.from_lines(np.ones((2, 8)), [0, 0], [3.0, 4.0], 0),
        lambda: LineSpreadFunction.from_lines(np.ones((0, 8)), [], [], 4),
        lambda: LineSpreadFunction.from_lines(np.zeros((2, 8)), [0, 0], [3.0, 4.0], 4),
        lambda: LineSpreadFunction(np.zeros((1, 1, 4)), np.zeros((1, 1, 5)), 0.0, 0.1),
        lambda: LineSpreadFunction(np.full((1, 1, 4), np.nan), np.zeros((1, 1, 4)), 0.0, 0.1),
    ],
)
def test_what_is_no_shape_is_refused(make):
    with pytest.raises(InvalidParameter):
        make()
