"""PixelRow: the light-sensitive part of a line sensor."""

from dataclasses import dataclass

from compute.errors import InvalidParameter


@dataclass(frozen=True)
class PixelRow:
    """A row of pixels, centred on the origin of the sensor's frame.

    Args:
        pixels: their number, at least 1.
        pitch_um: width of a pixel along the row [um].
        height_um: height of a pixel across the row [um].

    Raises:
        InvalidParameter: a number below 1, a size that is not positive.
    """

    pixels: int
    pitch_um: float
    height_um: float

    def __post_init__(self) -> None:
        if self.pixels < 1:
            raise InvalidParameter(
                f"pixels is {self.pixels}; it must be at least 1", pixels=self.pixels
            )
        for name in ("pitch_um", "height_um"):
            value = getattr(self, name)
            if not 0.0 < value < 1e5:
                raise InvalidParameter(
                    f"{name} is {value}; it must be positive, and below 1e5", **{name: value}
                )

    @property
    def pitch_mm(self) -> float:
        """Width of a pixel along the row [mm]."""
        return self.pitch_um * 1e-3

    @property
    def height_mm(self) -> float:
        """Height of a pixel across the row [mm]."""
        return self.height_um * 1e-3

    @property
    def middle_px(self) -> float:
        """Reading of the row's middle [px]."""
        return (self.pixels - 1) / 2.0
