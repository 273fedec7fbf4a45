"""SpinAxis: the axis of rotation of a tool, in tool and world coordinates, and its equations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.pose.tool_calibration.calibration_poses import CalibrationPoses
from compute.transform import cross_matrix

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

    @classmethod
    def linear(cls, poses: CalibrationPoses) -> "SpinAxis":
        """Return the least-squares axis of N poses in closed form."""
        left, _, right = np.linalg.svd(poses.rotations.mean(axis=0))
        tool_direction, world_direction = right[0], left[:, 0]
        across, other = _across(tool_direction), _across(world_direction)
        # other (R_i across' x + t_i) = y
        design = np.concatenate(
            [
                other @ poses.rotations @ across.T,
                np.broadcast_to(-np.eye(2), (len(poses), 2, 2)),
            ],
            axis=-1,
        ).reshape(-1, 4)
        goal = -(poses.translations_mm @ other.T).reshape(-1)
        solution = np.linalg.lstsq(design, goal, rcond=1e-9)[0]
        return cls(tool_direction, world_direction, solution[:2] @ across, solution[2:] @ other)

    def retract(self, step: Array) -> "SpinAxis":
        """Return the axis corrected by an increment: two parameters of each direction and point."""
        # Shifts along the axis are undetermined and removed.
        tool_direction, tool_point = _retract(
            self.tool_direction, self.tool_point, step[0:2], step[4:6]
        )
        world_direction, world_point = _retract(
            self.world_direction, self.world_point, step[2:4], step[6:8]
        )
        return SpinAxis(tool_direction, world_direction, tool_point, world_point)

    def differences(self, poses: CalibrationPoses) -> Array:
        """Return the differences of direction and point (tool less world) across it, (N, 4)."""
        other = self.across_world
        direction = poses.rotations @ self.tool_direction @ other.T
        point = poses.rotations @ self.tool_point + poses.translations_mm - self.world_point
        return np.concatenate([direction, point @ other.T], axis=1)

    def design(self, rotations: Array) -> Array:
        """Return the Jacobian of ``differences`` with respect to the axis, shape (N, 4, 8)."""
        design = np.zeros((len(rotations), 4, UNKNOWNS))
        rows = self.across_world @ rotations @ self.across_tool.T
        design[:, :2, 0:2] = design[:, 2:, 4:6] = rows
        design[:, :2, 2:4] = design[:, 2:, 6:8] = -np.eye(2)
        return design

    def pose_jacobian(self, rotations: Array) -> Array:
        """Return the Jacobian of ``differences`` with respect to the poses, shape (N, 4, 6).

        Its columns are rotation (left) [rad] and translation [mm].
        """
        other = self.across_world
        jacobian = np.zeros((len(rotations), 4, 6))
        jacobian[:, :2, :3] = -other @ cross_matrix(rotations @ self.tool_direction)
        jacobian[:, 2:, :3] = -other @ cross_matrix(rotations @ self.tool_point)
        jacobian[:, 2:, 3:] = other
        return jacobian


def _retract(
    direction: Array, point: Array, direction_step: Array, point_step: Array
) -> tuple[Array, Array]:
    """Return a corrected direction, of length 1, and the corrected point nearest to the origin."""
    across = _across(direction)
    direction = direction + direction_step @ across
    direction /= np.linalg.norm(direction)
    point = point + point_step @ across
    return direction, point - direction * (direction @ point)


def _across(direction: Array) -> Array:
    """Return two unit vectors across a direction, shape (2, 3)."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])
