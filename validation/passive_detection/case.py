"""Case passive-detection: detection and false-alarm rates of faint markers, and theory."""

from typing import Final

import numpy as np
from scipy.optimize import brentq

from validation.passive_detection.detection_rates import (
    FALSE_ALARMS,
    LINES,
    NEAR_PX,
    PIXELS,
    READ_ELECTRONS,
    SIGNAL_TO_BACKGROUND,
    WIDTH_PX,
    Point,
    Scene,
    Share,
    by_filter,
    by_own_noise,
    by_pixel,
    filter_detection_probability,
    line_filter,
)
from validation.result_tables import Cell, ResultTable, TablesCase

LIGHT_ELECTRONS: Final = (1000.0, 3000.0, 6000.0, 10000.0)
AVERAGED_ELECTRONS: Final = 200.0
AVERAGED_LINES: Final = (1, 3, 10, 30, 100, 300)
"""Section 3.6 summed as many as 300."""
AVERAGED_RATE: Final = 0.01
WANTED: Final = 0.9


def curve(scene: Scene) -> tuple[tuple[Point, Point], ...]:
    """Return the points of matched filter and single pixels, by the false alarms chosen."""
    return tuple((by_filter(scene, rate), by_pixel(scene, rate)) for rate in FALSE_ALARMS)


def compute_tables() -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the operating curves, measured and by theory, and what they show."""
    curves = {light: curve(Scene(light)) for light in LIGHT_ELECTRONS}
    averaged = {
        lines: (by_filter(scene, AVERAGED_RATE), by_pixel(scene, AVERAGED_RATE))
        for lines, scene in averaged_scenes().items()
    }
    pairs = [pair for points in curves.values() for pair in points] + list(averaged.values())
    filtered = _shares([pair[0] for pair in pairs])
    single = _shares([pair[1] for pair in pairs])
    matched = line_filter()
    needed = {light: light_needed(light) for light in (0.5, WANTED)}
    findings = (
        (
            f"The matched filter follows its theory: {len(filtered)} points, the worst "
            f"{_worst(filtered):.1f} standard errors off, {_mean_square(filtered):.2f} in mean "
            f"square; single pixels {_worst(single):.1f} and {_mean_square(single):.2f}."
        ),
        (
            f"It is worth {matched.snr_of_pixel_snr:.2f} times the signal-to-noise ratio of the "
            f"highest pixel, for lines of {WIDTH_PX:g} px, as would be "
            f"{matched.snr_of_pixel_snr**2:.1f} times the light, although it knows no background "
            "and the threshold on pixels was given it; with the background known it would be "
            f"{matched.snr_of_pixel_snr / matched.efficiency:.2f} times."
        ),
        (
            f"At {SIGNAL_TO_BACKGROUND} the light decides: half of the markers are found at "
            f"{needed[0.5]:.0f} electrons of background a pixel, 9 of 10 at {needed[WANTED]:.0f}, "
            f"with {AVERAGED_RATE:g} false alarms a line. Summing lines is light: so many lines "
            f"of {AVERAGED_ELECTRONS:.0f} electrons as it takes, "
            f"{lines_needed(WANTED):.0f} of them for 9 of 10, and section 3.6's 300 leave nothing "
            "to be missed."
        ),
        (
            f"Q(t - SNR), the chance at the marker's own place, is less than what is measured: "
            f"noise may lift an answer beside it, and any within {NEAR_PX} px counts. Theory is "
            "the jointly normal answers there, with the taps' correlation, over all phases of the "
            "marker within a pixel. The number of false alarms is that of the maxima of such "
            "answers over the line, times what the skewness of photon noise adds (up to "
            f"{_skewness(curves):.0%}, at {min(LIGHT_ELECTRONS):.0f} electrons)."
        ),
        (
            "Where the noise is measured in each line, by 256 of its pixels, the threshold is "
            "higher for its uncertainty: up to "
            f"{_own_noise_costs(averaged):.2f} of the markers are lost by that."
        ),
        (
            f"Assumed, for the text has neither light nor width: lines of {WIDTH_PX:g} px "
            f"(standard deviation), {READ_ELECTRONS:g} electrons of read noise, one electron a "
            f"count; {PIXELS} pixels are the frame grabber's. {LINES} lines with a marker and "
            f"{LINES} empty ones each; the background even, the deviation of a pixel known."
        ),
    )
    tables = (
        _theory_table(curves),
        _measured_table("matched filter", curves, 0),
        _measured_table("single pixels", curves, 1),
        _sums_table(averaged),
    )
    return tables, findings


def averaged_scenes() -> dict[int, Scene]:
    """Return the sums of lines, by how many."""
    return {lines: Scene(AVERAGED_ELECTRONS, lines) for lines in AVERAGED_LINES}


def light_needed(probability: float) -> float:
    """Return the background at which so many markers are found in one line [electrons]."""
    threshold = by_filter(Scene(LIGHT_ELECTRONS[0]), AVERAGED_RATE).threshold_sigma
    light = np.geomspace(1000.0, 30000.0, 25)
    probabilities = [
        filter_detection_probability(Scene(float(level)), threshold) for level in light
    ]
    return float(np.exp(np.interp(probability, probabilities, np.log(light))))


def lines_needed(probability: float) -> float:
    """Return how many lines of AVERAGED_ELECTRONS it takes, by the filter's own SNR."""
    expected = Scene(light_needed(probability)).snr

    def excess(lines: float) -> float:
        return Scene(AVERAGED_ELECTRONS).snr * float(np.sqrt(lines)) - expected

    return float(np.ceil(brentq(excess, 1.0, 1e5)))


def _theory_table(curves: dict[float, tuple[tuple[Point, Point], ...]]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for light, points in curves.items():
        for rate, (matched, pixel) in zip(FALSE_ALARMS, points, strict=True):
            rows.append(
                (
                    light, Scene(light).snr, rate, matched.threshold_sigma, matched.at_place,
                    matched.detections.expected, pixel.detections.expected,
                )
            )  # fmt: skip
    return ResultTable(
        f"theory of one line, signal by background {SIGNAL_TO_BACKGROUND}, by electrons of "
        "background and false alarms chosen per line: the chance to find a marker",
        (
            "electrons", "filter's SNR", "chosen", "threshold", "Q(t - SNR)",
            f"within {NEAR_PX} px", "single pixels",
        ),
        tuple(rows),
    )  # fmt: skip


def _measured_table(
    name: str, curves: dict[float, tuple[tuple[Point, Point], ...]], which: int
) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for light, points in curves.items():
        for rate, pair in zip(FALSE_ALARMS, points, strict=True):
            alarms, found = pair[which].false_alarms, pair[which].detections
            rows.append(
                (
                    light, rate, alarms.measured, alarms.expected,
                    found.measured, found.expected, found.deviations,
                )
            )  # fmt: skip
    return ResultTable(
        f"{name}, one line: false alarms per line, and the share of markers found; off in "
        "standard errors",
        ("electrons", "chosen", "false alarms", "with skewness", "found", "theory", "off"),
        tuple(rows),
    )


def _sums_table(averaged: dict[int, tuple[Point, Point]]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for lines, (matched, pixel) in averaged.items():
        scene = averaged_scenes()[lines]
        rows.append(
            (
                lines, scene.snr, matched.detections.measured, matched.detections.expected,
                by_own_noise(scene, AVERAGED_RATE),
                pixel.detections.measured, pixel.detections.expected,
            )
        )  # fmt: skip
    return ResultTable(
        f"sums of lines of {AVERAGED_ELECTRONS:.0f} electrons, {AVERAGED_RATE:g} false alarms "
        "per line: the share of markers found",
        (
            "lines", "filter's SNR", "found", "theory", "by own noise",
            "pixel: found", "pixel: theory",
        ),
        tuple(rows),
    )  # fmt: skip


def _shares(points: list[Point]) -> list[Share]:
    return [share for point in points for share in (point.false_alarms, point.detections)]


def _worst(shares: list[Share]) -> float:
    return max(abs(share.deviations) for share in shares)


def _mean_square(shares: list[Share]) -> float:
    return float(np.mean([share.deviations**2 for share in shares]))


def _skewness(curves: dict[float, tuple[tuple[Point, Point], ...]]) -> float:
    return max(
        pair[0].false_alarms.expected / rate - 1.0
        for points in curves.values()
        for rate, pair in zip(FALSE_ALARMS, points, strict=True)
    )


def _own_noise_costs(averaged: dict[int, tuple[Point, Point]]) -> float:
    return max(
        averaged[lines][0].detections.measured - by_own_noise(scene, AVERAGED_RATE)
        for lines, scene in averaged_scenes().items()
    )


CASE: Final = TablesCase(
    "passive-detection",
    "passive markers over a bright background: detection against false alarms",
    "section 3.6, [3.29]; section 4.4",
    compute_tables,
)
