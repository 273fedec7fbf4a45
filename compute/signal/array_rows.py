"""ArrayRows: base of dataclasses whose arrays have one row for each of their members."""

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray


class ArrayRows:
    """A dataclass of arrays of equal length; indexing returns some of its rows."""

    def __getitem__(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Self:
        """Return the rows of these numbers, or where a mask holds."""
        return type(self)(*(values[rows] for values in vars(self).values()))

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of all parts, of which there is one at least."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))
