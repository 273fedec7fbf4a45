"""Row of pixels of a line sensor."""

from dataclasses import dataclass
from typing import Final

from compute.parameter_checks import check_positive, require

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
        require(self.count <= _MAX_COUNT, f"be at most {_MAX_COUNT}", count=self.count)
        check_positive(self, "count", "pitch_um", "height_um")

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
        """Reading of the row's centre [px]."""
        return (self.count - 1) / 2.0
