"""SpinAxis: an axis about which a tool is turned, in the tool and in the world."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.pose.transform import cross_matrix

Array = NDArray[np.float64]

UNKNOWNS = 8
"""Two of each direction, two of each point."""
ROWS = 4
"""What a pose tells: two of the direction, two of the point."""


@dataclass(frozen=True, eq=False)
class SpinAxis:
    """Directions (3,) and points (3,) in the tool and in the world, with a basis across each."""

    tool: Array
    world: Array
    point: Array
    place: Array

    @property
    def across_tool(self) -> Array:
        """Two unit vectors across it in the tool, shape (2, 3)."""
        return _across(self.tool)

    @property
    def across_world(self) -> Array:
        """Two unit vectors across it in the world, shape (2, 3)."""
        return _across(self.world)

    def moved(self, step: Array) -> "SpinAxis":
        """Return it after a step: two of each direction, two of each point."""
        tool, world = self.across_tool, self.across_world
        turned = self.tool + step[0:2] @ tool
        other = self.world + step[2:4] @ world
        turned /= np.linalg.norm(turned)
        other /= np.linalg.norm(other)
        point = self.point + step[4:6] @ tool
        place = self.place + step[6:8] @ world
        # What slid along the axis means nothing.
        return SpinAxis(
            turned, other, point - turned * (turned @ point), place - other * (other @ place)
        )


def linear_axis(turned: Array, moved: Array) -> SpinAxis:
    """Return the axis by least squares of N poses, (N, 3, 3) and (N, 3), in closed form."""
    left, _, right = np.linalg.svd(turned.mean(axis=0))
    tool, world = right[0], left[:, 0]
    across, other = _across(tool), _across(world)
    # other (R_i across' x + t_i) = y
    design = np.concatenate(
        [other @ turned @ across.T, np.broadcast_to(-np.eye(2), (len(moved), 2, 2))], axis=-1
    )
    found = np.linalg.lstsq(design.reshape(-1, 4), -(moved @ other.T).reshape(-1), rcond=1e-9)[0]
    return SpinAxis(tool, world, found[:2] @ across, found[2:] @ other)


def axis_differences(turned: Array, moved: Array, axis: SpinAxis) -> Array:
    """Return direction's and point's differences across the axis, shape (N, 4)."""
    other = axis.across_world
    direction = turned @ axis.tool @ other.T
    point = (turned @ axis.point + moved - axis.place) @ other.T
    return np.concatenate([direction, point], axis=1)


def axis_design(turned: Array, axis: SpinAxis) -> Array:
    """Return the slopes of ``_off`` to the unknowns, shape (N, 4, 8)."""
    tool, other = axis.across_tool, axis.across_world
    design = np.zeros((len(turned), 4, UNKNOWNS))
    rows = other @ turned @ tool.T
    design[:, :2, 0:2] = design[:, 2:, 4:6] = rows
    design[:, :2, 2:4] = design[:, 2:, 6:8] = -np.eye(2)
    return design


def pose_slopes(turned: Array, axis: SpinAxis) -> Array:
    """Return the slopes of ``_off`` to turn and translation of the pose, shape (N, 4, 6)."""
    other = axis.across_world
    slopes = np.zeros((len(turned), 4, 6))
    slopes[:, :2, :3] = -other @ cross_matrix(turned @ axis.tool)
    slopes[:, 2:, :3] = -other @ cross_matrix(turned @ axis.point)
    slopes[:, 2:, 3:] = other
    return slopes


def _across(direction: Array) -> Array:
    """Return two unit vectors across a direction, shape (2, 3)."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])
