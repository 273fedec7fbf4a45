import numpy as np

from compute.mapping.cell_support import cell_corners, corner_values
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable

GRID = VoxelGrid((-1.0, 2.0, 5.0), (0.5, 0.7, 0.3), (4, 3, 5))


def interpolated(corners, points):
    """The variances of a table with these corners."""
    cells = GRID.cells
    table = CorrectionTable(
        ("s",),
        "",
        GRID,
        1,
        np.zeros((1, *corners.shape)),
        corners[None],
        np.ones((1, *cells), bool),
    )
    return table.at(points).variance_px2[:, 0]


def cell_means(function):
    """Of a fine lattice in every cell, shape (nx, ny, nz)."""
    steps = (np.arange(6) + 0.5) / 6.0
    axes = [np.add.outer(np.arange(count), steps).ravel() for count in GRID.cells]
    index = np.stack([one.ravel() for one in np.meshgrid(*axes, indexing="ij")], axis=1)
    values = function(np.asarray(GRID.origin_mm) + index * np.asarray(GRID.pitch_mm))
    x, y, z = GRID.cells
    return values.reshape(x, 6, y, 6, z, 6).mean(axis=(1, 3, 5))


def growing(points):
    """A little in the middle and much at the rim, as a fit's variance."""
    half = 0.5 * (GRID.end_mm - np.asarray(GRID.origin_mm))
    return 0.1 + (((points - np.asarray(GRID.origin_mm) - half) / half) ** 4).sum(axis=1)


def test_cells_have_the_functions_means() -> None:
    right = cell_means(growing)
    found = corner_values(GRID, growing)
    assert (found > 0.0).all()
    off = cell_means(lambda points: interpolated(found, points)) / right - 1.0
    plain = growing(cell_corners(GRID)).reshape(found.shape)
    plain_off = cell_means(lambda points: interpolated(plain, points)) / right - 1.0
    assert plain_off.mean() > 0.15
    assert np.abs(off).mean() < 0.04
    assert np.abs(off).max() < 0.12


def test_a_linear_function_stays_as_it_is() -> None:
    def linear(points):
        return 9.0 + points @ [1.0, -0.5, 0.3]

    expected = linear(cell_corners(GRID)).reshape([count + 1 for count in GRID.cells])
    np.testing.assert_allclose(corner_values(GRID, linear), expected, rtol=1e-12)
