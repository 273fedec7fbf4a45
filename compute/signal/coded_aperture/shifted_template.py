"""ShiftedTemplate: a template on whole lines by its shift, without a look-up for every pixel."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from compute.signal.coded_aperture.shadow_template import ShadowTemplate

Array = NDArray[np.float64]


class ShiftedTemplate:
    """The cubics of a template, those of one phase side by side.

    All pixels of a line lie at the same place in their cells, so that a shift picks one row of
    coefficients and one start in it. The result is that of ``ShadowTemplate.at``.

    Args:
        template: the template.
        pixels: pixels of a line.
    """

    def __init__(self, template: ShadowTemplate, pixels: int) -> None:
        self._template = template
        # A line's length on each side: any shift that leaves something on the line.
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
        """Return value, slope [1/px] and what is known, shape (L, P), at shifts (L,) [px]."""
        per_px = self._template.per_px
        cell = -(shift_px + self._template.first_px) * per_px
        whole = np.floor(cell)
        part = (cell - whole)[:, None]
        start, phase = np.divmod(whole.astype(np.int64), per_px)
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
