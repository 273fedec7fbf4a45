"""PointBatch and PointEstimate: reconstructed points as arrays, and one as a value."""

from dataclasses import dataclass
from enum import IntFlag
from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3
from compute.flags import flag_names

POINT_BYTES: Final = 108
"""Bytes of a point's position, covariance, chi2 and flags."""


class PointFlag(IntFlag):
    """Why a point is missing or to be used with care."""

    NONE = 0
    TOO_FEW_SENSORS = 1
    """Fewer than three sensors saw it: no position."""
    DEGENERATE = 2
    """The planes meet in a line, not in a point: no position."""
    NO_CONVERGENCE = 4
    """No position: the iteration left the cameras' field, did not converge, or ended where the
    planes of exactly three sensors do not meet, though three planes always could."""
    NO_REDUNDANCY = 8
    """Exactly three sensors: the residual is zero whatever the errors are."""
    INCONSISTENT = 16
    """The residual is larger than the readings' noise explains."""
    AMBIGUOUS = 32
    """Another grouping of the sensors' peaks is as likely."""
    SUSPECT_PEAK = 64
    """One of its peaks is suspect by the flag policy."""
    OUTSIDE_MAP = 128
    """It lies where the correction table is not valid for some used sensor."""


@dataclass(frozen=True)
class PointEstimate:
    """One reconstructed point.

    Args:
        position_mm: X, Y, Z in the world frame [mm]; None where there is no position.
        covariance_mm2: its covariance [mm^2], the calibration's own included.
        residual_sigma: root of chi2 per degree of freedom; None without redundancy.
        sensors: names of the sensors used.
        flags: names of the flags that hold, in lower case with hyphens.
    """

    position_mm: Vector3 | None
    covariance_mm2: tuple[Vector3, Vector3, Vector3] | None
    residual_sigma: float | None
    sensors: tuple[str, ...]
    flags: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PointBatch:
    """N reconstructed points as arrays; NaN where there is no position.

    Args:
        position_mm: shape (N, 3) [mm].
        covariance_mm2: shape (N, 3, 3) [mm^2].
        chi2: weighted sum of squared residuals, shape (N,).
        used: which sensors each point comes from, shape (N, S).
        flags: PointFlag values, int32, shape (N,).
    """

    position_mm: NDArray[np.float64]
    covariance_mm2: NDArray[np.float64]
    chi2: NDArray[np.float64]
    used: NDArray[np.bool_]
    flags: NDArray[np.int32]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position_mm)

    def part(self, first: int, last: int) -> "PointBatch":
        """Return a range of the points; the arrays are shared.

        Args:
            first: index of the first point.
            last: index after the last point.
        """
        rows = slice(first, last)
        return PointBatch(
            self.position_mm[rows],
            self.covariance_mm2[rows],
            self.chi2[rows],
            self.used[rows],
            self.flags[rows],
        )

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "PointBatch":
        """Return some of the points, by their indices or by a mask."""
        return PointBatch(
            self.position_mm[index],
            self.covariance_mm2[index],
            self.chi2[index],
            self.used[index],
            self.flags[index],
        )

    @classmethod
    def empty(cls, sensors: int) -> "PointBatch":
        """Return the batch of no points, for a number of sensors."""
        return cls(
            np.empty((0, 3)),
            np.empty((0, 3, 3)),
            np.empty(0),
            np.empty((0, sensors), dtype=np.bool_),
            np.empty(0, dtype=np.int32),
        )

    @classmethod
    def allocate(cls, count: int, sensors: int) -> "PointBatch":
        """Return a batch to be filled, in one block of memory.

        Args:
            count: number of points N.
            sensors: number of sensors S.
        """
        block = np.empty(count * (POINT_BYTES + sensors), dtype=np.uint8)
        return cls(
            np.ndarray((count, 3), np.float64, block),
            np.ndarray((count, 3, 3), np.float64, block, 24 * count),
            np.ndarray((count,), np.float64, block, 96 * count),
            np.ndarray((count, sensors), np.bool_, block, POINT_BYTES * count),
            np.ndarray((count,), np.int32, block, 104 * count),
        )

    @classmethod
    def concatenate(cls, parts: "list[PointBatch]") -> "PointBatch":
        """Return the points of one batch or more, in order."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            np.concatenate([part.position_mm for part in parts]),
            np.concatenate([part.covariance_mm2 for part in parts]),
            np.concatenate([part.chi2 for part in parts]),
            np.concatenate([part.used for part in parts]),
            np.concatenate([part.flags for part in parts]),
        )

    def residual_sigma(self) -> NDArray[np.float64]:
        """Root of chi2 per degree of freedom, shape (N,); NaN without redundancy."""
        dof = self.used.sum(axis=1) - 3
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(dof > 0, np.sqrt(self.chi2 / np.maximum(dof, 1)), np.nan)

    def estimates(self, names: tuple[str, ...]) -> list[PointEstimate]:
        """Return the points as values; ``names`` are the sensors' names in order."""
        rows = zip(
            self.position_mm.tolist(),
            self.covariance_mm2.tolist(),
            self.residual_sigma().tolist(),
            self.used.tolist(),
            self.flags.tolist(),
            strict=True,
        )
        estimates = []
        for position, covariance, sigma, used, flags in rows:
            found = isfinite(position[0])
            estimates.append(
                PointEstimate(
                    tuple(position) if found else None,
                    (tuple(covariance[0]), tuple(covariance[1]), tuple(covariance[2]))
                    if found
                    else None,
                    sigma if isfinite(sigma) else None,
                    tuple(name for name, use in zip(names, used, strict=True) if use),
                    flag_names(PointFlag(flags)),
                )
            )
        return estimates
