"""Coded window: a flat plate with a bar code before a line sensor, as in CODA."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import max_len_seq

from compute.errors import InvalidParameter
from compute.parameter_checks import check_not_negative, check_positive, require

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CodedWindow:
    """A plane-parallel plate with a bar code on the side of the sensor, in an opaque frame.

    The frame of reference has its origin in the middle of the code, x and y in the plane of the
    mask and z towards the object: the pixels lie at ``z = -gap_mm``, the plate fills 0 to
    ``plate_thickness_mm``. A shadow moves against the marker, so readings grow towards -x on
    the pixels and along +x of the object, as behind a lens; the first bar of the code lies at +x
    where its shadow has the lowest reading. Without a plate the shadow of the code's middle
    is read as ``p0 + gap X / Z``: the gap is the principal distance. (Thesis section 2.4,
    Figures 2.16 and 2.17; the figures give no dimensions.)

    Args:
        code: the bars in the order of growing readings, 1 transparent, 0 opaque.
        bar_mm: width of one bar [mm].
        gap_mm: air between the mask and the pixels [mm].
        plate_thickness_mm: thickness of the plate [mm]; 0: a mask without a plate.
        plate_index: refractive index of the plate, from 1 to below 10.
        height_mm: length of the bars, along y [mm]; may be infinite.

    Raises:
        InvalidParameter: a code that is empty, holds something else than 0 and 1, or no
            transparent bar; a width, gap or height not positive; a thickness below zero; an
            index out of range.
    """

    code: tuple[int, ...]
    bar_mm: float
    gap_mm: float
    plate_thickness_mm: float = 0.0
    plate_index: float = 1.0
    height_mm: float = np.inf

    def __post_init__(self) -> None:
        if not self.code:
            raise InvalidParameter("code is empty; give at least one bar", code=self.code)
        for bar, bit in enumerate(self.code):
            if bit not in (0, 1):
                raise InvalidParameter(
                    f"code has {bit!r} as bar {bar + 1}; a bar is 1 (transparent) or 0 (opaque)",
                    code=bit,
                )
        if not any(self.code):
            raise InvalidParameter(
                f"code has {len(self.code)} opaque bars and no transparent one; light must pass",
                code=self.code,
            )
        check_positive(self, "bar_mm", "gap_mm")
        require(self.height_mm > 0.0, "be positive", height_mm=self.height_mm)
        check_not_negative(self, "plate_thickness_mm")
        valid = 1.0 <= self.plate_index < 10.0
        require(valid, "be from 1 to below 10", plate_index=self.plate_index)

    @property
    def length_mm(self) -> float:
        """Length of the code, across its bars [mm]."""
        return len(self.code) * self.bar_mm


def maximal_length_code(order: int) -> tuple[int, ...]:
    """Return the pseudo-random code of ``2**order - 1`` bars, a maximal-length sequence.

    All its cyclic shifts correlate alike and low, which makes the peak of [2.16] stand out.

    Args:
        order: length of the shift register, 2 to 16.

    Raises:
        InvalidParameter: the order is out of range.
    """
    require(2 <= order <= 16, "be 2 to 16", order=order)
    sequence, _ = max_len_seq(order)
    return tuple(int(bit) for bit in sequence)
