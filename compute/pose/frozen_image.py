"""Frozen image: peaks that come again and again, the same to the bit, show nothing of now."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

SAME_MOST: Final = 5
"""Exposures of a marker, or of all, that are identical: noise makes no two of a live sensor so."""


class FrozenImage:
    """Tells whether a camera sends its last image with newer stamps; the tool may be anywhere."""

    def __init__(self) -> None:
        """Begin without any exposure."""
        self._last: dict[int | None, bytes] = {}
        self._times: dict[int | None, int] = {}

    def see(self, marker: int | None, position_px: NDArray[np.float64]) -> None:
        """Take in the peaks of a frame.

        Args:
            marker: strobe slot that was lit; None: all markers.
            position_px: shape (S, K) [px]; NaN where there are fewer than K.
        """
        if (marker is None) != (None in self._last):
            # The strobe was switched on or off: what it showed before is no measure.
            self._last.clear()
            self._times.clear()
        there = np.isfinite(position_px)
        shown = position_px[there].tobytes() + there.sum(axis=1).tobytes()
        same = self._last.get(marker) == shown and bool(there.any())
        self._last[marker] = shown
        self._times[marker] = self._times[marker] + 1 if same else 1

    def of(self, slots: tuple[int, ...] | None) -> bool:
        """Return whether the exposures of a tool's markers do not change; None: lit together."""
        if self._times.get(None, 0) >= SAME_MOST:
            return True
        return any(self._times.get(slot, 0) >= SAME_MOST for slot in slots or ())
