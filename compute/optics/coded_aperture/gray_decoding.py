"""Reading of a Gray plate: from the tracks' outputs to a position, with its doubts."""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.gray_code import from_bits, gray_decode
from compute.optics.coded_aperture.gray_plate import GrayPlate

Array = NDArray[np.float64]

_NARROWEST_CELLS = 0.2
_WIDEST_CELLS = 2.0
_FARTHEST_CELLS = 1.0
_CURVE_POINTS = 4097
_CELLS_PER_PERIOD = 4


class GrayFlag(IntFlag):
    """What is doubtful in a reading."""

    NO_LIGHT = 1
    """The reference, the sum of a track and its complement, is below the least signal."""
    AMBIGUOUS_TRACK = 2
    """A Gray track is near its threshold; the position holds, unless INCONSISTENT is set too."""
    INCONSISTENT = 4
    """The interpolated phase lies half a cell or more outside of the Gray cell."""


@dataclass(frozen=True, eq=False)
class GrayReading:
    """Positions on a Gray plate; arrays of the outputs' leading shape.

    Args:
        position_mm: middle of the step that was read [mm]; NaN without light.
        code: number of the step, 0 to ``2**bits - 1``, int64; -1 without light.
        quantisation_sigma_mm: standard deviation of the rounding, step / sqrt(12) [mm].
        flags: GrayFlag, int32.
        ambiguous: tracks of the Gray code near their threshold, shape (..., gray_bits).
    """

    position_mm: Array
    code: NDArray[np.int64]
    quantisation_sigma_mm: float
    flags: NDArray[np.int32]
    ambiguous: NDArray[np.bool_]


def read_gray(
    plate: GrayPlate,
    outputs: Array,
    *,
    line_sigma_mm: float,
    margin: float = 0.1,
    min_signal: float = 0.0,
) -> GrayReading:
    """Read positions from the outputs of the tracks.

    Each Gray track is compared with half of the reference; the bits give a cell. The sine and
    cosine tracks give a phase in their period of four cells, straightened by the response that
    a line of the given width has, and the period is the one that brings it nearest to the
    cell's middle. A Gray track at its threshold errs by one cell at most, which this repairs.
    The position is then rounded to the plate's bits.

    Near the ends of the plate, within about four standard deviations of the line, part of its
    light is lost and the reading errs by more than a step. A false Gray track is noticed
    (INCONSISTENT) in about half of all places: it mirrors cells, by odd numbers of them.

    Args:
        plate: the plate.
        outputs: of the tracks, shape (..., tracks), any unit.
        line_sigma_mm: standard deviation of the line's shape [mm], from 0.2 to 2 cells: in a
            narrower one the quadrature tracks stand still between edges, from a wider one
            they have no contrast.
        margin: a track is ambiguous within this share of the reference about its threshold.
        min_signal: reference below or at which there is no light, in the unit of the outputs.

    Raises:
        InvalidParameter: outputs of another number of tracks, a width, margin or signal out
            of its range.
    """
    if outputs.ndim < 1 or outputs.shape[-1] != plate.tracks:
        raise InvalidParameter(
            f"outputs have the shape {outputs.shape}; their last axis must be the plate's "
            f"{plate.tracks} tracks",
            shape=outputs.shape,
        )
    low, high = _NARROWEST_CELLS * plate.cell_mm, _WIDEST_CELLS * plate.cell_mm
    if not low <= line_sigma_mm <= high:
        raise InvalidParameter(
            f"line_sigma_mm is {line_sigma_mm}; to be interpolated it must be {low:.6g} to "
            f"{high:.6g}, {_NARROWEST_CELLS} to {_WIDEST_CELLS} cells",
            line_sigma_mm=line_sigma_mm,
        )
    if not 0.0 <= margin < 0.5:
        raise InvalidParameter(f"margin is {margin}; it must be 0 to below 0.5", margin=margin)
    if not 0.0 <= min_signal < np.inf:
        raise InvalidParameter(
            f"min_signal is {min_signal}; it must be zero or positive",
            min_signal=min_signal,
        )
    sine_track = plate.gray_bits
    reference = outputs[..., sine_track] + outputs[..., sine_track + 1]
    lit = reference > min_signal
    relative = outputs / np.where(lit, reference, 1.0)[..., None]

    gray = relative[..., : plate.gray_bits]
    ambiguous = (abs(gray - 0.5) < margin) & lit[..., None]
    cell = gray_decode(from_bits(gray > 0.5))
    # The finest Gray track is the complement of the cosine.
    sine = relative[..., sine_track] - relative[..., sine_track + 1]
    cosine = relative[..., sine_track + 2] - relative[..., sine_track - 1]
    in_period = _straighten(np.arctan2(sine, cosine), line_sigma_mm / plate.cell_mm)

    middle = cell + 0.5
    periods = np.rint((middle - in_period) / _CELLS_PER_PERIOD)
    place = in_period + _CELLS_PER_PERIOD * periods
    steps = 2**plate.analogue_bits
    code = np.clip(np.floor(place * steps), 0, 2**plate.bits - 1).astype(np.int64)
    # Within half a cell of the middle; beyond it a track at its threshold may have erred, near
    # the edge between the cells, and nowhere else.
    flags = np.where(ambiguous.any(axis=-1), GrayFlag.AMBIGUOUS_TRACK, 0)
    flags |= np.where(abs(place - middle) > _FARTHEST_CELLS, GrayFlag.INCONSISTENT, 0)
    flags = np.where(lit, flags, GrayFlag.NO_LIGHT)
    return GrayReading(
        position_mm=np.where(lit, (code + 0.5) * plate.step_mm, np.nan),
        code=np.where(lit, code, -1),
        quantisation_sigma_mm=plate.quantisation_sigma_mm,
        flags=flags.astype(np.int32),
        ambiguous=ambiguous,
    )


def _straighten(phase_rad: Array, sigma_cells: float) -> Array:
    """Return the place in a period [cells] at which a line of the width gives the phase."""
    place = np.linspace(-0.5, 0.5, _CURVE_POINTS) * _CELLS_PER_PERIOD
    angle = 2.0 * np.pi * place / _CELLS_PER_PERIOD
    # Fourier series of the square wave, damped by the line's width: 4/(pi k), odd k.
    order = np.arange(1, 80, 2)
    damping = np.exp(-2.0 * (np.pi * order * sigma_cells / _CELLS_PER_PERIOD) ** 2) / order
    sine = np.sin(angle[:, None] * order) @ damping
    cosine = np.cos(angle[:, None] * order) @ (damping * (-1.0) ** (order // 2))
    curve = np.unwrap(np.arctan2(sine, cosine))
    return np.asarray(np.interp(phase_rad, curve, place))
