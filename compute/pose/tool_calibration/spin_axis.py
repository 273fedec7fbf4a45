"""SpinAxis: the axis of rotation of a tool, in tool and world coordinates, and its equations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.pose.transform import cross_matrix

Array = NDArray[np.float64]

UNKNOWNS = 8
"""Two parameters for each direction, two for each point."""
ROWS = 4
"""Equations of a pose: two for the direction, two for the point."""


@dataclass(frozen=True, eq=False)
class SpinAxis:
    """Directions (3,) and points (3,) [mm] of the axis in the tool and in the world."""

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
        """Return the axis corrected by an increment: two parameters of each direction and point."""
        tool_direction, world_direction = self.across_tool, self.across_world
        rotations = self.tool_direction + step[0:2] @ tool_direction
        other = self.world_direction + step[2:4] @ world_direction
        rotations /= np.linalg.norm(rotations)
        other /= np.linalg.norm(other)
        tool_point = self.tool_point + step[4:6] @ tool_direction
        world_point = self.world_point + step[6:8] @ world_direction
        # Shifts along the axis are undetermined and removed.
        return SpinAxis(
            rotations,
            other,
            tool_point - rotations * (rotations @ tool_point),
            world_point - other * (other @ world_point),
        )


def linear_axis(rotations: Array, translations: Array) -> SpinAxis:
    """Return the least-squares axis of N poses in closed form.

    Args:
        rotations: R_world_tool, shape (N, 3, 3).
        translations: shape (N, 3) [mm].
    """
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
    """Return the differences of direction and point (tool less world) across the axis, (N, 4).

    Args:
        rotations: R_world_tool, shape (N, 3, 3).
        translations: shape (N, 3) [mm].
        axis: the axis.
    """
    other = axis.across_world
    direction = rotations @ axis.tool_direction @ other.T
    tool_point = (rotations @ axis.tool_point + translations - axis.world_point) @ other.T
    return np.concatenate([direction, tool_point], axis=1)


def axis_design(rotations: Array, axis: SpinAxis) -> Array:
    """Return the Jacobian of ``axis_differences`` with respect to the axis, shape (N, 4, 8).

    Args:
        rotations: R_world_tool, shape (N, 3, 3).
        axis: the axis.
    """
    tool_direction, other = axis.across_tool, axis.across_world
    design = np.zeros((len(rotations), 4, UNKNOWNS))
    rows = other @ rotations @ tool_direction.T
    design[:, :2, 0:2] = design[:, 2:, 4:6] = rows
    design[:, :2, 2:4] = design[:, 2:, 6:8] = -np.eye(2)
    return design


def pose_jacobian(rotations: Array, axis: SpinAxis) -> Array:
    """Return the Jacobian of ``axis_differences`` with respect to the poses, shape (N, 4, 6).

    Its columns are rotation (left) [rad] and translation [mm].

    Args:
        rotations: R_world_tool, shape (N, 3, 3).
        axis: the axis.
    """
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
