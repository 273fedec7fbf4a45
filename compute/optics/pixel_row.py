"""Row of pixels of a line sensor."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from compute.errors import InvalidParameter

_MAX_COUNT: Final = 1_000_000


@dataclass(frozen=True)
class PixelRow:
    """A row of pixels, centred on the origin of the sensor's frame.

    Args:
        count: number of pixels.
        pitch_um: centre to centre [um].
        height_um: sensitive size across the row [um].

    Raises:
        InvalidParameter: a value that is not positive and finite, or a count above a million.
    """

    count: int
    pitch_um: float
    height_um: float

    def __post_init__(self) -> None:
        if self.count > _MAX_COUNT:
            raise InvalidParameter(
                f"count is {self.count}; it must be at most {_MAX_COUNT}", count=self.count
            )
        for name in ("count", "pitch_um", "height_um"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                raise InvalidParameter(f"{name} is {value}; it must be positive", **{name: value})

    @property
    def pitch_mm(self) -> float:
        """Pixel pitch [mm]."""
        return self.pitch_um * 1e-3

    @property
    def height_mm(self) -> float:
        """Pixel height across the row [mm]."""
        return self.height_um * 1e-3

    @property
    def length_mm(self) -> float:
        """Length of the row [mm]."""
        return self.count * self.pitch_mm

    @property
    def centre_px(self) -> float:
        """Reading of the row's middle [px]."""
        return (self.count - 1) / 2.0
