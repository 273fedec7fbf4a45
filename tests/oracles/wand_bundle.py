"""Least squares of a wand's readings with free 2 x 4 cameras, from any start.

Cameras are free matrices, poses a centre and a direction; nothing is shared with ``compute``. The
scales of the matrices and the frame are free: damping holds them.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WandBundle:
    """Cameras and poses of a wand.

    Args:
        matrices: ``p = (m1 . X) / (m2 . X)``, shape (S, 2, 4).
        centre: of the wand, shape (B, 3) [mm].
        direction: unit vectors from the first end to the second, shape (B, 3).
        length: of the wand [mm].
        readings: over their standard deviation, shape (B, 2, S); NaN where not seen.
    """

    matrices: Array
    centre: Array
    direction: Array
    length: float
    readings: Array

    @classmethod
    def placed(cls, matrices: Array, length: float, readings: Array) -> Self:
        """Return poses triangulated linearly with given cameras; poses that cannot be are dropped.

        Args:
            matrices: for readings over their standard deviation, shape (S, 2, 4).
            length: of the wand [mm].
            readings: over their standard deviation, shape (B, 2, S); NaN where not seen.
        """
        seen = np.isfinite(readings)
        kept = (seen.sum(axis=2) >= 3).all(axis=1)
        readings, seen = readings[kept], seen[kept]
        rows = np.where(seen, readings, 0.0)[..., None] * matrices[:, 1] - matrices[:, 0]
        rows = rows / np.linalg.norm(matrices[:, 1, :3], axis=1)[:, None] * seen[..., None]
        ends = np.stack(
            [
                [np.linalg.lstsq(end[:, :3], -end[:, 3], rcond=None)[0] for end in pose]
                for pose in rows
            ]
        )
        between = ends[:, 1] - ends[:, 0]
        size = np.linalg.norm(between, axis=1, keepdims=True)
        return cls(matrices, ends.mean(axis=1), between / size, length, readings)

    @property
    def ends(self) -> Array:
        """The ends, shape (B, 2, 3) [mm]."""
        half = 0.5 * self.length * self.direction
        return np.stack([self.centre - half, self.centre + half], axis=1)

    @property
    def chi2(self) -> Array:
        """Sum of squares of each pose, shape (B,); inf with a point behind a sensor."""
        image = np.einsum("sij,bkj->bksi", self.matrices[..., :3], self.ends)
        image = image + self.matrices[..., 3]
        seen = np.isfinite(self.readings)
        residual = np.where(seen, image[..., 0] / image[..., 1] - self.readings, 0.0)
        behind = (image[..., 1] <= 0.0) & seen
        squares = (residual**2).sum(axis=(1, 2))
        return np.where(behind.any(axis=(1, 2)), np.inf, squares)

    def _moved(self, cameras: Array, poses: Array, tangents: Array) -> Self:
        direction = self.direction + np.einsum("bji,bj->bi", tangents, poses[:, 3:])
        return replace(
            self,
            matrices=self.matrices + cameras.reshape(self.matrices.shape),
            centre=self.centre + poses[:, :3],
            direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        )

    def minimised(self, iterations: int = 3000, *, cameras_free: bool = True) -> Self:
        """Minimise the squares by Levenberg-Marquardt with scaled damping.

        Args:
            iterations: largest number of steps.
            cameras_free: False: only the poses move.
        """
        state, damping = self, 1e-3
        quiet = 0
        for _ in range(iterations):
            step = state._step(damping, cameras_free)
            old, new = float(state.chi2.sum()), float(step.chi2.sum())
            if new < old:
                quiet = quiet + 1 if old - new < 1e-9 * old else 0
                state, damping = step, max(0.3 * damping, 1e-12)
            else:
                damping *= 4.0
            if quiet > 20 or damping > 1e12:
                break
        return state

    def _step(self, damping: float, cameras_free: bool) -> Self:
        sensors, poses = len(self.matrices), len(self.centre)
        ends = self.ends
        point = np.concatenate([ends, np.ones((poses, 2, 1))], axis=2)
        image = np.einsum("sij,bkj->bksi", self.matrices, point)
        seen = np.isfinite(self.readings)
        inverse = np.where(seen, 1.0 / image[..., 1], 0.0)[..., None]
        value = image[..., :1] / image[..., 1:]
        residual = np.where(seen, value[..., 0] - self.readings, 0.0)
        by_first = inverse * point[:, :, None]
        by_camera = np.concatenate([by_first, -value * by_first], axis=3)  # (B, 2, S, 8)
        gradient = (self.matrices[:, 0, :3] - value * self.matrices[:, 1, :3]) * inverse
        tangents = np.linalg.svd(self.direction[:, None])[2][:, 1:]  # (B, 2, 3)
        lever = 0.5 * self.length * np.array([-1.0, 1.0])[:, None, None]
        turned = np.einsum("bksi,bji->bksj", gradient, tangents) * lever
        by_pose = np.concatenate([gradient, turned], axis=3)  # (B, 2, S, 5)
        normal = np.einsum("bksi,bksj->bij", by_pose, by_pose)
        index = np.arange(5)
        normal[:, index, index] *= 1.0 + damping
        normal[:, index, index] += 1e-12 * normal[:, index, index].max(axis=1, keepdims=True)
        slope = np.einsum("bksi,bks->bi", by_pose, residual)
        wide = np.zeros((poses, 2, sensors, sensors, 8))
        wide[:, :, np.arange(sensors), np.arange(sensors)] = by_camera
        rows = wide.reshape(poses, 2 * sensors, 8 * sensors)
        mixed = np.swapaxes(rows, 1, 2) @ by_pose.reshape(poses, 2 * sensors, 5)
        solved = np.linalg.inv(normal)
        camera_step = np.zeros(8 * sensors)
        if cameras_free:
            flat = rows.reshape(-1, 8 * sensors)
            full = flat.T @ flat
            diagonal = np.diagonal(full).copy()
            full -= np.einsum("bai,bij,bcj->ac", mixed, solved, mixed, optimize=True)
            right = -(flat.T @ residual.ravel())
            right += np.einsum("bai,bij,bj->a", mixed, solved, slope, optimize=True)
            scale = np.sqrt(diagonal)
            full = full / scale[:, None] / scale + (damping + 1e-11) * np.eye(len(scale))
            camera_step = np.linalg.solve(full, right / scale) / scale
        coupled = slope + np.einsum("bai,a->bi", mixed, camera_step)
        pose_step = -np.einsum("bij,bj->bi", solved, coupled)
        return self._moved(camera_step, pose_step, tangents)
