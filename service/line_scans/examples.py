"""Examples of line scans to post: one line with three peaks, two of them close together."""

from typing import Any, Final

# Gaussian lines of 1.2 px at 31.3, 78.2 and 81.9 px, with 9, 11 and 6 thousand electrons.
_LINE: Final = [
    120, 122, 122, 122, 121, 118, 120, 120, 121, 121, 120, 119, 120, 121, 123, 123,
    117, 121, 122, 120, 118, 122, 122, 123, 122, 120, 120, 122, 129, 167, 280, 407,
    363, 236, 147, 126, 118, 122, 118, 119, 123, 119, 120, 117, 119, 120, 124, 123,
    119, 118, 119, 123, 119, 118, 124, 119, 120, 119, 119, 118, 117, 119, 121, 119,
    118, 118, 119, 121, 118, 119, 123, 120, 119, 124, 119, 130, 196, 351, 489, 418,
    301, 294, 320, 251, 170, 130, 124, 120, 121, 122, 118, 122, 122, 120, 122, 118,
]  # fmt: skip
_NOISE: Final = {
    "electrons_per_count": 10.0,
    "read_noise_electrons": 15.0,
    "offset_counts": 100.0,
    "full_scale_counts": 4095,
}

NEW_LINE_SCANS: Final[dict[str, Any]] = {
    "fit": {
        "summary": "Fitted, lines of about 1.2 px, the sensor's noise known",
        "value": {
            "lines": [_LINE],
            "method": {"method": "fit", "width_px": 1.2},
            "noise": _NOISE,
            "detail": True,
        },
    },
    "centroid": {
        "summary": "Centres of gravity, the noise guessed from the line",
        "value": {"lines": [_LINE], "method": {"method": "centroid"}},
    },
    "chain": {
        "summary": "The thesis's chain: smoothed, background removed, close peaks taken apart",
        "value": {
            "lines": [_LINE],
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
        "summary": "Matched filter, one false alarm in a hundred lines",
        "value": {
            "lines": [_LINE],
            "method": {"method": "matched", "width_px": 1.2, "false_alarms_per_line": 0.01},
            "noise": _NOISE,
            "detail": True,
        },
    },
}
