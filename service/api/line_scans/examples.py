"""Example requests: a scan with three peaks, two of them close; a coded shadow."""

from typing import Any, Final

import numpy as np

# Gaussian scans of 1.2 px at 31.3, 78.2 and 81.9 px, with 9, 11 and 6 thousand electrons.
_LINE: Final = [
    120, 122, 122, 122, 121, 118, 120, 120, 121, 121, 120, 119, 120, 121, 123, 123,
    117, 121, 122, 120, 118, 122, 122, 123, 122, 120, 120, 122, 129, 167, 280, 407,
    363, 236, 147, 126, 118, 122, 118, 119, 123, 119, 120, 117, 119, 120, 124, 123,
    119, 118, 119, 123, 119, 118, 124, 119, 120, 119, 119, 118, 117, 119, 121, 119,
    118, 118, 119, 121, 118, 119, 123, 120, 119, 124, 119, 130, 196, 351, 489, 418,
    301, 294, 320, 251, 170, 130, 124, 120, 121, 122, 118, 122, 122, 120, 122, 118,
]  # fmt: skip

# The shadow of 13 bars of 4 px, two cells a pixel, its edges 0.7 px wide, and a line with it
# 30.3 px farther, its reading at 61.8 px.
_BARS: Final = (1, 1, 1, 1, 1, 0, 0, 1, 1, 0, 1, 0, 1)
_EDGE: Final = (0.004, 0.024, 0.094, 0.255, 0.5, 0.745, 0.906, 0.976, 0.996)
_SHADOW_LINE: Final = [
    122, 120, 113, 120, 120, 119, 122, 118, 122, 119, 121, 119, 119, 123, 120, 118,
    120, 120, 120, 120, 118, 120, 121, 119, 119, 121, 123, 121, 119, 117, 116, 120,
    120, 118, 123, 161, 304, 410, 419, 420, 418, 425, 431, 426, 417, 427, 412, 415,
    420, 427, 419, 419, 426, 419, 427, 381, 242, 139, 123, 117, 117, 116, 122, 160,
    299, 399, 414, 416, 420, 419, 416, 362, 238, 136, 124, 164, 303, 405, 414, 371,
    243, 139, 120, 165, 298, 395, 427, 380, 237, 135, 120, 119, 120, 122, 117, 120,
    120, 120, 122, 119, 123, 121, 119, 120, 118, 122, 124, 121, 119, 120, 121, 122,
    116, 118, 120, 119, 118, 123, 119, 115, 126, 122, 121, 120, 121, 123, 122, 121,
]  # fmt: skip


def _shadow_cells() -> list[float]:
    cell, bar = np.arange(128), np.flatnonzero(_BARS)[:, None]
    begun, ended = (
        np.interp(cell - first - 8 * bar, np.arange(-4, 5), _EDGE, left=0.0, right=1.0)
        for first in (11, 19)
    )
    cells: list[float] = (begun - ended).sum(axis=0).round(3).tolist()
    return cells


_NOISE: Final = {
    "electrons_per_count": 10.0,
    "read_noise_electrons": 15.0,
    "offset_counts": 100.0,
    "full_scale_counts": 4095,
}

NEW_LINE_SCANS: Final[dict[str, Any]] = {
    "fit": {
        "summary": "Fitted, scans of about 1.2 px, the sensor's noise known",
        "value": {
            "scans": [_LINE],
            "method": {"method": "fit", "width_px": 1.2},
            "noise": _NOISE,
            "detail": True,
        },
    },
    "centroid": {
        "summary": "Centres of gravity, the noise guessed from the line",
        "value": {"scans": [_LINE], "method": {"method": "centroid"}},
    },
    "chain": {
        "summary": "The thesis's chain: smoothed, background removed, close peaks taken apart",
        "value": {
            "scans": [_LINE],
            "method": {
                "method": "chain",
                "line_filter": {"kind": "butterworth", "order": 4, "cutoff": 0.6},
                "background": {"kind": "polynomial", "degree": 1},
                "separation": {"kind": "slope-extension", "level_fraction": 0.2},
            },
            "noise": _NOISE,
            "detail": True,
        },
    },
    "matched": {
        "summary": "Matched filter, one false alarm in a hundred scans",
        "value": {
            "scans": [_LINE],
            "method": {"method": "matched", "width_px": 1.2, "false_alarms_per_line": 0.01},
            "noise": _NOISE,
            "detail": True,
        },
    },
    "mask": {
        "summary": "The shadow of a coded window, by its template",
        "value": {
            "scans": [_SHADOW_LINE],
            "method": {
                "method": "mask",
                "template": {"cells": _shadow_cells(), "per_px": 2, "reading_px": 31.5},
            },
            "noise": _NOISE,
            "detail": True,
        },
    },
}
