"""Case peak-efficiency: fit and centres of gravity beside the Cramer-Rao bound."""

from collections.abc import Callable, Sequence
from math import isnan
from typing import Final

from validation.peak_efficiency.bias import FAINT, Bias, bias_figures
from validation.peak_efficiency.monte_carlo import (
    DEFAULT,
    EDGE,
    FITTED,
    GRAVITY,
    KNOWN_WIDTH,
    PRIOR,
    SETTINGS,
    WRONG_WIDTH,
    Efficiency,
    Errors,
    efficiency,
)
from validation.peak_efficiency.shape_tables import shape_tables
from validation.result_tables import Cell, ResultTable, TablesCase
from validation.synthetic_scans import AMBIENT, GAIN

SEED: Final = 1
LINES: Final = 6000
"""Exposures of each setting: errors of an RMS of 0.9 %, of a mean square of 1.8 %."""
USEFUL_PX: Final = 0.2
"""Up to which bound estimators are compared."""
BIAS_LINES: Final = 100_000
"""Exposures of each setting for the bias of faint lines: its errors are a quarter."""
NEES_TOLERANCE: Final = 0.05
"""How far from 1 the mean square of errors in stated deviations may be."""


def compute_tables(seed: int = SEED) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables of Gaussian lines and of lines of other shapes, and what they show.

    Args:
        seed: of the noise of Gaussian lines.
    """
    lines = [efficiency(setting, LINES, seed) for setting in SETTINGS]
    shapes, shape_findings = shape_tables()
    biases = {
        name: [bias_figures(setting, name, BIAS_LINES, seed) for setting in FAINT]
        for name in (KNOWN_WIDTH, FITTED, DEFAULT)
    }
    tables = (_known(lines), _others(lines), _gravity(lines), _bias(biases), *shapes)
    return tables, (*_findings(lines), _biased(biases), *shape_findings)


def useful(lines: Sequence[Efficiency]) -> list[Efficiency]:
    """Return those whose bound is below USEFUL_PX."""
    return [line for line in lines if line.strict_px < USEFUL_PX]


def _known(lines: Sequence[Efficiency]) -> ResultTable:
    return _table(
        "the fit, width known, by deviation [px] / light / read noise [electrons]: share found, "
        "bound [px], RMS and bias by the bound, square",
        ("found", "bound", "RMS", "bias", "+-", "square"),
        lines,
        lambda line: (
            round(line.found, 4),
            round(line.strict_px, 4),
            *_beside(line, line.errors[KNOWN_WIDTH]),
        ),
    )


def _others(lines: Sequence[Efficiency]) -> ResultTable:
    return _table(
        "the fit, width fitted; as FitSettings comes (next to nothing known of the width); and "
        "known to 10 %, but believed 5 % too large: RMS and bias by the bound, square",
        (
            *("RMS", "bias", "square", "RMS as it comes", "bias as it comes"),
            *("square as it comes", "RMS 10 %", "bias 10 %", "square 10 %"),
        ),
        lines,
        lambda line: (*_bare(line, FITTED), *_bare(line, DEFAULT), *_bare(line, PRIOR)),
    )


def _gravity(lines: Sequence[Efficiency]) -> ResultTable:
    return _table(
        "centre of gravity above a third, as in the thesis (4.2.2), and corrected at its edges: "
        "RMS and bias by the bound, square",
        ("RMS", "bias", "square", "RMS edges", "bias edges", "square edges"),
        lines,
        lambda line: (*_bare(line, GRAVITY), *_bare(line, EDGE)),
    )


def _table(
    title: str,
    headings: tuple[str, ...],
    lines: Sequence[Efficiency],
    cells: Callable[[Efficiency], tuple[Cell, ...]],
) -> ResultTable:
    rows = tuple((label(line), *cells(line)) for line in lines)
    return ResultTable(title, ("line", *headings), rows)


def _bias(biases: dict[str, list[Bias]]) -> ResultTable:
    rows = []
    for known, *free in zip(*biases.values(), strict=True):
        cells: list[Cell] = [label(known), round(known.allowed_px, 4)]
        for one in (known, *free):
            errors = one.errors
            figures = (one.bias_px, one.bias_error_px, one.second_order_px)
            cells += [round(figure, 5) for figure in figures]
            cells += [round(errors.rms_px / one.strict_px, 3), round(errors.nees, 3)]
        rows.append(tuple(cells))
    headings = [
        f"{heading} {name}"
        for name in ("known", "fitted", "as it comes")
        for heading in ("bias", "+-", "second order", "RMS", "square")
    ]
    return ResultTable(
        f"bias [px] of faint lines by {BIAS_LINES} of each, at that place in a pixel where it is "
        "largest, beside the largest expected to second order; RMS by the bound, square",
        ("line", "allowed", *headings),
        tuple(rows),
    )


def label(line: Efficiency | Bias) -> str:
    """Return a setting in a few letters: deviation / light / read noise."""
    setting = line.setting
    return f"{setting.width_px:g} / {setting.light:.0e} / {setting.read_noise:g}".replace("+0", "")


def _bare(line: Efficiency, name: str) -> tuple[Cell, ...]:
    ratio, bias, _, nees = _beside(line, line.errors[name])
    return ratio, bias, nees


def _beside(line: Efficiency, errors: Errors) -> tuple[Cell, ...]:
    """Return an estimator's errors by the strict bound; empty cells where it has none."""
    figures = (
        errors.rms_px / line.strict_px,
        errors.bias_px / line.strict_px,
        errors.bias_error_px / line.strict_px,
        errors.nees,
    )
    return tuple(None if isnan(figure) else round(figure, 4) for figure in figures)


def _findings(lines: Sequence[Efficiency]) -> tuple[str, ...]:
    good = useful(lines)
    faint = [line for line in lines if line not in good]
    missed = [line for line in good if line.found < 0.999]

    def ratios(name: str, some: Sequence[Efficiency] = good) -> list[float]:
        return [line.errors[name].rms_px / line.strict_px for line in some]

    def squares(name: str) -> list[float]:
        return [line.errors[name].nees for line in good]

    biased = max(good, key=lambda line: line.errors[KNOWN_WIDTH].bias_px / line.strict_px)
    bias = biased.errors[KNOWN_WIDTH]
    where = _where

    return (
        (
            f"Of {len(lines)} settings {len(good)} have a bound below {USEFUL_PX} px. There the "
            f"fit with the width known has {min(ratios(KNOWN_WIDTH)):.3f} to "
            f"{max(ratios(KNOWN_WIDTH)):.3f} "
            "of the bound for which nothing but the position is unknown, give or take "
            f"{(2 * LINES) ** -0.5:.3f} by chance. Its bias, at the worst place in a pixel, is "
            f"{bias.bias_px / biased.strict_px:.3f} +- "
            f"{bias.bias_error_px / biased.strict_px:.3f} of the bound at most "
            f"({bias.bias_px:.4f} px: {where(biased)}), and the squared errors in stated "
            f"deviations average {min(squares(KNOWN_WIDTH)):.2f} to "
            f"{max(squares(KNOWN_WIDTH)):.2f}."
        ),
        (
            "A symmetric line's position is not correlated with light, level and width: unknown, "
            f"all three make the bound {_nuisance(lines):.4f} times as large at most. What an "
            "unknown width costs is of higher order: its error weighs the pixels as for another "
            "line. Fitted with the width unknown the RMS is at most "
            f"{max(ratios(FITTED)):.3f} of the strict bound and the squares average "
            f"{min(squares(FITTED)):.2f} to {max(squares(FITTED)):.2f}; as FitSettings comes "
            f"{max(ratios(DEFAULT)):.3f}, and {min(squares(DEFAULT)):.2f} to "
            f"{max(squares(DEFAULT)):.2f}. Known to 10 %, and believed {WRONG_WIDTH:g} of the "
            f"true one, {max(ratios(PRIOR)):.3f}, and {min(squares(PRIOR)):.2f} to "
            f"{max(squares(PRIOR)):.2f}."
        ),
        _inconsistent_sigma(good),
        (
            f"The thesis's centre of gravity has {min(ratios(GRAVITY)):.2f} to "
            f"{max(ratios(GRAVITY)):.1f} of the bound, that corrected at its edges "
            f"{min(ratios(EDGE)):.2f} to {max(ratios(EDGE)):.1f}: by the error within a pixel, "
            "which more light does not make smaller."
        ),
        (
            "Past the bound of 0.2 px, the fit with the width known: "
            + "; ".join(
                f"{line.errors[KNOWN_WIDTH].rms_px / line.strict_px:.2f} of "
                f"{line.strict_px:.2f} px "
                f"({where(line)}, {100 * line.found:.0f} % found)"
                for line in faint
            )
            + "."
        ),
        (
            "The search by single pixels, at six deviations, does not find every faint line ("
            + "; ".join(f"{100 * line.found:.0f} % of {where(line)}" for line in missed)
            + "): a matched filter does, and is compute.signal.detection. To measure "
            "the estimator all the same, the fit of a line that was not found starts from its true "
            "place with a normal error of a third of its width. Centres of gravity are of the "
            "lines that were found."
        ),
        (
            f"Exposures: Poisson light and {AMBIENT:g} electrons of ambient light, read noise, "
            f"{GAIN:g} electrons a count, rounded; positions evenly over a pixel; {LINES} lines a "
            "setting. From the errors whose mean is the bias the first-order error by the known "
            "noise is subtracted, whose mean is zero: the bias's standard error (+-) becomes an "
            "eighth or less. Of the bias the largest of 16 places in a pixel counts."
        ),
    )


def _where(line: Efficiency | Bias) -> str:
    setting = line.setting
    return f"{setting.width_px:g} px, {setting.light:.0f} electrons, noise {setting.read_noise:g}"


def _inconsistent_sigma(good: Sequence[Efficiency]) -> str:
    """Say where squared errors in stated deviations are not 1 within HONEST, by what is known."""

    def beyond(name: str) -> str:
        out = [line for line in good if abs(line.errors[name].nees - 1.0) > NEES_TOLERANCE]
        each = "; ".join(f"{line.errors[name].nees:.2f} at {_where(line)}" for line in out)
        return each or "nowhere"

    return (
        f"Squared errors in stated deviations that average outside {1 - NEES_TOLERANCE:.2f} to "
        f"{1 + NEES_TOLERANCE:.2f} (+- {(2 / LINES) ** 0.5:.3f} by chance): with the width known "
        f"{beyond(KNOWN_WIDTH)}. As FitSettings comes {beyond(DEFAULT)}. With the width unknown "
        f"{beyond(FITTED)}. In faint light a fitted width varies by about a fifth, and a deviation "
        "stated for the most probable width would be too small where that is too narrow: their "
        "deviations are averaged over the widths that the pixels leave open (FitSettings, Unknown "
        "width)."
    )


def _biased(biases: dict[str, list[Bias]]) -> str:
    """Say how large the biases of faint lines are, and where larger than allowed."""

    def most(name: str) -> str:
        worst = max(biases[name], key=lambda one: one.bias_px / one.allowed_px)
        return (
            f"{worst.bias_px:.4f} +- {worst.bias_error_px:.4f} px of {worst.allowed_px:.4f} px "
            f"({_where(worst)}; {worst.second_order_px:.4f} px to second order)"
        )

    beyond = [
        f"{one.bias_px:.4f} px, {name}, at {_where(one)}"
        for name, some in biases.items()
        for one in some
        if one.bias_px > one.allowed_px
    ]
    return (
        f"Of biases 0.002 px or 2 % of the bound, the larger, is allowed. Nearest to it, by "
        f"{BIAS_LINES} lines of each kind: with the width known {most(KNOWN_WIDTH)}, with "
        "the width "
        f"fitted {most(FITTED)}, as FitSettings comes {most(DEFAULT)}. More than is allowed: "
        f"{'; '.join(beyond) or 'nowhere'}. A line of 0.6 px, believed narrower or wider, is drawn "
        "towards or from its pixel's middle."
    )


def _nuisance(lines: Sequence[Efficiency]) -> float:
    return max(line.bound_px / line.strict_px for line in lines)


CASE: Final = TablesCase(
    "peak-efficiency",
    "how near the fit of one line comes to the Cramer-Rao bound",
    "section 4.1 [4.1] and 4.2.2, beside the bound",
    compute_tables,
)
