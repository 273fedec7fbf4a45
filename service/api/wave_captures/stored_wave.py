"""StoredWave: the readings that were taken of a waved target, as they are stored."""

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StoredWave:
    """Stored poses of a waved target, and the counts of its exposures.

    Args:
        readings_px: shape (B, K, S) [px]; NaN where not seen.
        sigma_px: their standard deviations, the same shape [px]; NaN where not known.
        counts: exposures of the first marker by what became of them, as PoseCounts has them.
        seen: exposures of each sensor with a clear peak, an unclear one, none, shape (3, S).
    """

    readings_px: Array
    sigma_px: Array
    counts: tuple[int, int, int, int]
    seen: NDArray[np.intp]

    @classmethod
    def empty(cls, markers: int, sensors: int) -> "StoredWave":
        """Return no poses."""
        none = np.empty((0, markers, sensors))
        return cls(none, none, (0, 0, 0, 0), np.zeros((3, sensors), dtype=np.intp))

    def pack(self) -> bytes:
        """Return it as a NumPy archive."""
        file = io.BytesIO()
        np.savez_compressed(
            file,
            readings_px=self.readings_px,
            sigma_px=self.sigma_px,
            counts=np.array(self.counts),
            seen=self.seen,
        )
        return file.getvalue()

    @classmethod
    def unpack(cls, data: bytes) -> "StoredWave":
        """Return what ``pack`` packed."""
        with np.load(io.BytesIO(data), allow_pickle=False) as found:
            taken, still, too_few, not_lit = found["counts"].tolist()
            return cls(
                found["readings_px"],
                found["sigma_px"],
                (taken, still, too_few, not_lit),
                found["seen"],
            )
