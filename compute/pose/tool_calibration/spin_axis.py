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

    tool_direction: Array
    world_direction: Array
    tool_point: Array
    world_point: Array

    @property
    def across_tool(self) -> Array:
        """Two unit vectors across it in the tool, shape (2, 3)."""
        return _across(self.tool_direction)

    @property
    def across_world(self) -> Array:
        """Two unit vectors across it in the world, shape (2, 3)."""
        return _across(self.world_direction)

    def retract(self, step: Array) -> "SpinAxis":
        """Return it after a step: two of each direction, two of each point."""
        tool_direction, world_direction = self.across_tool, self.across_world
        rotations = self.tool_direction + step[0:2] @ tool_direction
        other = self.world_direction + step[2:4] @ world_direction
        rotations /= np.linalg.norm(rotations)
        other /= np.linalg.norm(other)
        tool_point = self.tool_point + step[4:6] @ tool_direction
        world_point = self.world_point + step[6:8] @ world_direction
        # What slid along the axis means nothing.
        return SpinAxis(
            rotations,
            other,
            tool_point - rotations * (rotations @ tool_point),
            world_point - other * (other @ world_point),
        )


def linear_axis(rotations: Array, translations: Array) -> SpinAxis:
    """Return the axis by least squares of N poses, (N, 3, 3) and (N, 3), in closed form."""
    left, _, right = np.linalg.svd(rotations.mean(axis=0))
    tool_direction, world_direction = right[0], left[:, 0]
    across, other = _across(tool_direction), _across(world_direction)
    # other (R_i across' x + t_i) = y
    design = np.concatenate(
        [other @ rotations @ across.T, np.broadcast_to(-np.eye(2), (len(translations), 2, 2))],
        axis=-1,
    )
    found = np.linalg.lstsq(
        design.reshape(-1, 4), -(translations @ other.T).reshape(-1), rcond=1e-9
    )[0]
    return SpinAxis(tool_direction, world_direction, found[:2] @ across, found[2:] @ other)


def axis_differences(rotations: Array, translations: Array, axis: SpinAxis) -> Array:
    """Return direction's and point's differences across the axis, shape (N, 4)."""
    other = axis.across_world
    direction = rotations @ axis.tool_direction @ other.T
    tool_point = (rotations @ axis.tool_point + translations - axis.world_point) @ other.T
    return np.concatenate([direction, tool_point], axis=1)


def axis_design(rotations: Array, axis: SpinAxis) -> Array:
    """Return the slopes of ``_residuals`` to the unknowns, shape (N, 4, 8)."""
    tool_direction, other = axis.across_tool, axis.across_world
    design = np.zeros((len(rotations), 4, UNKNOWNS))
    rows = other @ rotations @ tool_direction.T
    design[:, :2, 0:2] = design[:, 2:, 4:6] = rows
    design[:, :2, 2:4] = design[:, 2:, 6:8] = -np.eye(2)
    return design


def pose_jacobian(rotations: Array, axis: SpinAxis) -> Array:
    """Return the slopes of ``_residuals`` to turn and translation of the pose, shape (N, 4, 6)."""
    other = axis.across_world
    jacobian = np.zeros((len(rotations), 4, 6))
    jacobian[:, :2, :3] = -other @ cross_matrix(rotations @ axis.tool_direction)
    jacobian[:, 2:, :3] = -other @ cross_matrix(rotations @ axis.tool_point)
    jacobian[:, 2:, 3:] = other
    return jacobian


def _across(direction: Array) -> Array:
    """Return two unit vectors across a direction, shape (2, 3)."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])
