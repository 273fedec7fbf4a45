"""Batch: items as arrays, one row each; PointBatch: reconstructed points, PointEstimate: one."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import IntFlag
from functools import cache
from itertools import compress
from math import isfinite
from typing import Annotated, Any, Self, cast, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3
from compute.flags import flag_names

Array = NDArray[np.float64]
Rows = NDArray[np.intp] | NDArray[np.bool_] | slice
"""Indices of rows, or a mask."""


class Batch:
    """Base of dataclasses whose fields are arrays or batches, with one row for each item.

    ``Annotated[Array, "S", 3]`` is an array with rows of shape (S, 3), for S sensors;
    "M": motion models.
    """

    def __len__(self) -> int:
        """Return the number of items."""
        first: Array | Batch = next(iter(vars(self).values()))
        return len(first)

    @classmethod
    def zeros(cls, count: int, sensors: int, models: int = 1) -> Self:
        """Return a batch of zeros.

        Args:
            count: number of items.
            sensors: number of sensors S.
            models: number of motion models M.
        """
        sizes = {"S": sensors, "M": models}
        columns = []
        for kind, axes in _columns(cast("Any", cls)):
            shape = (count, *(sizes.get(axis, axis) for axis in axes))
            columns.append(
                kind.zeros(count, sensors, models)
                if issubclass(kind, Batch)
                else np.zeros(shape, kind)
            )
        return cls(*columns)

    @classmethod
    def empty(cls, sensors: int, models: int = 1) -> Self:
        """Return the batch of no items.

        Args:
            sensors: number of sensors S.
            models: number of motion models M.
        """
        return cls.zeros(0, sensors, models)

    def rows(self, index: Rows) -> Self:
        """Return some of the items."""
        return type(self)(
            *[
                value.rows(index) if isinstance(value, Batch) else value[index]
                for value in vars(self).values()
            ]
        )

    def part(self, first: int, last: int) -> Self:
        """Return a range of the items; the arrays are shared.

        Args:
            first: index of the first item.
            last: index after the last item.
        """
        return self.rows(slice(first, last))

    def put(self, index: Rows, items: Self) -> None:
        """Overwrite some of the items.

        Args:
            index: their rows, or a mask.
            items: the new items, one for each of them.
        """
        for value, new in zip(vars(self).values(), vars(items).values(), strict=True):
            if isinstance(value, Batch):
                value.put(index, new)
            else:
                value[index] = new

    @classmethod
    def concatenate(cls, parts: Iterable[Self]) -> Self:
        """Return the items of one batch or more, in order."""
        every = list(parts)
        filled = [part for part in every if len(part)] or every[:1]
        if len(filled) == 1:
            return filled[0]
        columns = zip(*(vars(part).values() for part in filled), strict=True)
        return cls(
            *(
                type(column[0]).concatenate(column)
                if isinstance(column[0], Batch)
                else np.concatenate(column)
                for column in columns
            )
        )


@cache
def _columns(batch: type[Batch]) -> list[tuple[Any, tuple[Any, ...]]]:
    """Return the type of each column's values, or its batch, and the axes of a row."""
    columns = []
    for hint in get_type_hints(batch, include_extras=True).values():
        kind, *axes = get_args(hint) if hasattr(hint, "__metadata__") else (hint,)
        columns.append((_value_type(kind), tuple(axes)))
    return columns


def _value_type(kind: Any) -> Any:
    """Return a batch, or the type of an array's values.

    NDArray[T] is ndarray[shape, dtype[T]] or, by newer NumPy and Python, an alias of its own.
    """
    while not isinstance(kind, type):
        *_, kind = get_args(kind)
    return kind


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
    READING_EXCLUDED = 256
    """One reading or two contradicted the others and were left out: five sensors or more."""
    NOT_IDENTIFIABLE = 512
    """A reading is wrong, and the others do not tell which: the position may be off by any amount.
    With four sensors this is always so."""


@dataclass(frozen=True)
class PointEstimate:
    """One reconstructed point.

    Args:
        position_mm: X, Y, Z in the world frame [mm]; None where there is no position.
        covariance_mm2: its covariance [mm^2], the calibration's own included.
        residual_sigma: root of chi2 per degree of freedom; None without redundancy.
        sensors: names of the sensors used.
        flags: names of the flags that hold, in lower case with hyphens.
        external_reliability_mm: largest shift of the position by an error of one reading that the
            others would reveal with a probability of 0.8 [mm]; None: nothing checks a reading.
    """

    position_mm: Vector3 | None
    covariance_mm2: tuple[Vector3, Vector3, Vector3] | None
    residual_sigma: float | None
    sensors: tuple[str, ...]
    flags: tuple[str, ...]
    external_reliability_mm: float | None = field(default=None, kw_only=True)


@dataclass(frozen=True, eq=False)
class PointBatch(Batch):
    """N reconstructed points as arrays; NaN where there is no position.

    Args:
        position_mm: shape (N, 3) [mm].
        covariance_mm2: shape (N, 3, 3) [mm^2].
        chi2: weighted sum of squared residuals, shape (N,).
        external_reliability_mm: Baarda's external reliability: largest shift of the point by a
            minimal detectable error of one reading, shape (N,) [mm]; infinite where nothing checks
            some reading, as with three sensors.
        used: which sensors each point comes from, shape (N, S).
        flags: PointFlag values, int32, shape (N,).
    """

    position_mm: Annotated[Array, 3]
    covariance_mm2: Annotated[Array, 3, 3]
    chi2: Array
    external_reliability_mm: Array
    used: Annotated[NDArray[np.bool_], "S"]
    flags: NDArray[np.int32]

    def residual_sigma(self) -> Array:
        """Root of chi2 per degree of freedom, shape (N,); NaN without redundancy."""
        dof = self.used.sum(axis=1) - 3.0
        dof[dof < 0.5] = np.nan
        root: Array = np.sqrt(self.chi2 / dof)
        return root

    def estimates(self, names: tuple[str, ...]) -> list[PointEstimate]:
        """Return the points as values; ``names`` are the sensors' names in order."""
        columns = vars(self) | {"chi2": self.residual_sigma()}
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        return [
            PointEstimate(
                tuple(position) if isfinite(position[0]) else None,
                (tuple(covariance[0]), tuple(covariance[1]), tuple(covariance[2]))
                if isfinite(position[0])
                else None,
                sigma if isfinite(sigma) else None,
                tuple(compress(names, used)),
                flag_names(PointFlag(flags)),
                external_reliability_mm=reliability if isfinite(reliability) else None,
            )
            for position, covariance, sigma, reliability, used, flags in rows
        ]
