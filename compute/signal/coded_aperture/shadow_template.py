"""Template of a coded shadow, on a grid finer than pixels."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from compute.errors import InvalidParameter
from compute.parameter_checks import require

Array = NDArray[np.float64]

_ON_GRID: Final = 0.02
"""By how much of a cell a shift may lie beside the grid."""

_LIT: Final = 0.5


@dataclass(frozen=True, eq=False)
class ShadowTemplate:
    """Light of a pixel at any position in the shadow of a reference point.

    Between the cells a cubic spline through them is read. A template that is known pixel by
    pixel alone (``per_px`` 1) makes that spline guess what the pixels have averaged, and the
    shift is then wrong by up to hundredths of a pixel, by the phase; so let the optics say it:
    form the shadows of points whose readings are a part of a pixel apart, and ``weave`` them.

    Args:
        cells: light of the pixels centred at ``first_px + j / per_px``, float64, shape (C,).
        per_px: cells per pixel.
        first_px: place of the first cell on the scan.
        reading_px: the reference point's reading; ``reading = reading_px + shift``.
        dark_beyond: nothing but ambient light beyond the cells; False: the pattern goes on there,
            but is not known, and pixels there are left out.
    """

    cells: Array
    per_px: int
    first_px: int
    reading_px: float
    dark_beyond: bool

    def __post_init__(self) -> None:
        require(self.per_px >= 1, "be 1 or more", per_px=self.per_px)
        if self.cells.ndim != 1 or self.cells.size < 8 * self.per_px:
            raise InvalidParameter(
                f"cells have the shape {self.cells.shape}; they must be one row of 8 pixels or "
                f"more, {8 * self.per_px} cells",
                shape=self.cells.shape,
            )
        if not (np.isfinite(self.cells).all() and np.isfinite(self.reading_px)):
            raise InvalidParameter("cells or reading_px hold a value that is not finite")
        if not np.ptp(self.cells) > 0.0:
            raise InvalidParameter(
                f"cells are {self.cells[0]} everywhere; they must have contrast",
                cells=float(self.cells[0]),
            )

    @cached_property
    def spline(self) -> Array:
        """Cubic polynomials between the cells, by powers of the position [cells], (C - 1, 4)."""
        # Natural ends: no more is made of the first and last cells than they say.
        cubic = CubicSpline(np.arange(len(self.cells)), self.cells, bc_type="natural")
        return np.ascontiguousarray(cubic.c[::-1].T)

    @property
    def pixels(self) -> int:
        """Whole pixels that the cells cover."""
        return -(-len(self.cells) // self.per_px)

    @cached_property
    def pixel_values(self) -> Array:
        """The cells on whole pixels, from ``first_px`` on, shape (pixels,)."""
        return np.ascontiguousarray(self.cells[:: self.per_px])

    @cached_property
    def height(self) -> float:
        """Difference of the darkest and the brightest cell."""
        return float(np.ptp(self.cells))

    @cached_property
    def lit_width_px(self) -> float:
        """Distance of the first from the last cell that is half lit [px]."""
        lit = np.flatnonzero(self.cells - self.cells.min() >= _LIT * self.height)
        return float(lit[-1] - lit[0]) / self.per_px

    def at(self, position_px: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return value, derivative [1/px] and whether they are known at positions [px].

        Places are on the scan on which the reference point's reading is ``reading_px``. Beyond
        the cells the value is 0, and known where it is dark.
        """
        cell = (position_px - self.first_px) * self.per_px
        cell_index = np.floor(cell)
        inside = (cell_index >= 0) & (cell_index < len(self.cells) - 1)
        part = cell - cell_index
        cubic = self.spline[np.where(inside, cell_index, 0.0).astype(np.int64)]
        value = cubic[..., 3] * part
        value += cubic[..., 2]
        value *= part
        value += cubic[..., 1]
        value *= part
        value += cubic[..., 0]
        slope = (3.0 * cubic[..., 3] * part + 2.0 * cubic[..., 2]) * part + cubic[..., 1]
        slope *= self.per_px
        value[~inside] = 0.0
        slope[~inside] = 0.0
        return value, slope, inside | self.dark_beyond


def interleave_scans(
    scans: ArrayLike,
    shifts_px: ArrayLike,
    *,
    reading_px: float,
    per_px: int,
    dark_beyond: bool,
) -> ShadowTemplate:
    """Interleave shadows that lie fractions of a pixel apart to one template.

    A pixel i of a shadow shifted by s says what a pixel at ``i - s`` of the template gets. Where
    several say it, the shadow with the least shift is believed, so that shadows shifted by
    hundreds of pixels carry a pattern on that is longer than the scan.

    Args:
        scans: light of the pixels, from the optics, shape (K, P).
        shifts_px: their readings less ``reading_px``, multiples of ``1 / per_px`` (to a fiftieth
            of it), together of every phase, shape (K,) [px].
        reading_px: the reference point's reading [px].
        per_px: cells per pixel.
        dark_beyond: as of ShadowTemplate.

    Raises:
        InvalidParameter: shapes that do not agree, a shift beside the grid, or cells between the
            first and last that no shadow says.
    """
    light = np.asarray(scans, dtype=np.float64)
    shift = np.asarray(shifts_px, dtype=np.float64)
    if light.ndim != 2 or shift.shape != light.shape[:1] or light.size == 0:
        raise InvalidParameter(
            f"lines and shifts_px have the shapes {light.shape} and {shift.shape}; they must be "
            "(K, P) and (K,)",
            shapes=(light.shape, shift.shape),
        )
    cell = np.rint(-shift * per_px)
    beside = np.abs(-shift * per_px - cell)
    worst = float(shift[beside.argmax()])
    require(beside.max() <= _ON_GRID, f"be a multiple of 1/{per_px} px", shift_px=worst)
    start = cell.astype(np.int64)
    # From a whole pixel on.
    first = int(start.min()) // per_px
    index = start[:, None] - first * per_px + np.arange(light.shape[1]) * per_px
    cells = np.full(int(index.max()) + 1, np.nan)
    for row in np.argsort(-np.abs(shift), kind="stable"):
        cells[index[row]] = light[row]
    finite = np.flatnonzero(~np.isnan(cells))
    missing = np.flatnonzero(np.isnan(cells[finite[0] :]))
    if missing.size and _has_gaps(cells[finite[0] :], per_px):
        raise InvalidParameter(
            f"shifts_px leave holes in the template, the first at cell {int(missing[0])} of "
            f"{per_px} per pixel; give a shadow for every phase",
            cell=int(missing[0]),
        )
    begin = -(-finite[0] // per_px) * per_px
    end = begin + int(np.argmax(np.append(np.isnan(cells[begin:]), True)))
    return ShadowTemplate(
        cells[begin:end], per_px, first + int(begin) // per_px, float(reading_px), dark_beyond
    )


def _has_gaps(cells: Array, per_px: int) -> bool:
    """Say whether cells are missing but in the pixel at either end."""
    return bool(np.isnan(cells[per_px:-per_px]).any())


class ShiftedTemplate:
    """The template's polynomials, arranged by phase for whole scans.

    All pixels of a scan lie at the same place in their cells, so that a shift picks one row of
    coefficients and one start in it. The result is that of ``ShadowTemplate.at``.

    Args:
        template: the template.
        pixels: pixels of a scan.
    """

    def __init__(self, template: ShadowTemplate, pixels: int) -> None:
        self._template = template
        # A scan's length on each side: any shift that leaves something on the scan.
        self._before = pixels
        self._last = pixels + template.pixels
        per_px = template.per_px
        cells = np.zeros((self._last + pixels) * per_px * 4).reshape(-1, 4)
        known = np.full(len(cells), template.dark_beyond)
        inside = slice(pixels * per_px, pixels * per_px + len(template.spline))
        cells[inside], known[inside] = template.spline, True
        rows = np.ascontiguousarray(cells.reshape(-1, per_px, 4).transpose(1, 2, 0))
        self._cubics = sliding_window_view(rows, pixels, axis=2)
        self._known = sliding_window_view(
            np.ascontiguousarray(known.reshape(-1, per_px).T), pixels, axis=1
        )

    def at(self, shift_px: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return value, derivative [1/px] and where they are known, (L, P), at shifts (L,) [px]."""
        per_px = self._template.per_px
        cell = -(shift_px + self._template.first_px) * per_px
        cell_index = np.floor(cell)
        part = (cell - cell_index)[:, None]
        start, phase = np.divmod(cell_index.astype(np.int64), per_px)
        start = np.clip(start + self._before, 0, self._last)
        cubic = self._cubics[phase, :, start]
        zeroth, first, second, third = (cubic[:, power] for power in range(4))
        bend = third * part
        slope = 3.0 * bend
        bend += second
        slope += 2.0 * second
        slope *= part
        slope += first
        slope *= per_px
        bend *= part
        bend += first
        bend *= part
        bend += zeroth
        return bend, slope, self._known[phase, start]
