"""Tables of case peak-efficiency about non-Gaussian stripes."""

from collections.abc import Sequence
from typing import Final

from validation.peak_efficiency.field_dependent_shape import (
    BY_PLACE,
    FROM_MIDDLE,
    GAUSSIAN,
    LIGHT,
    NODES,
    PLACES,
    PlaceFigures,
    place_figures,
)
from validation.peak_efficiency.non_gaussian import (
    ALLOWING,
    AS_GAUSSIAN,
    AS_MEASURED,
    LIGHTS,
    OPTICS,
    READ_NOISE,
    SHAPE_ERROR,
    ShapeFigures,
    optical_line,
    shape_figures,
)
from validation.result_tables import ResultTable

SHAPE_LINES: Final = 120
"""Exposures of each shape at each of 16 places in a pixel."""
_SHORT: Final = {AS_GAUSSIAN: "Gauss", ALLOWING: "5 %", AS_MEASURED: "own"}


def shape_tables() -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables and the findings."""
    shapes = [shape_figures(optics, light, SHAPE_LINES) for optics in OPTICS for light in LIGHTS]
    positions = [place_figures(field, SHAPE_LINES) for field in PLACES]
    tables = (_shapes(shapes), _squares(shapes), _knowing(shapes), *_by_place(positions))
    return tables, (*_shape_findings(shapes), _place_finding(positions))


def _shapes(shapes: Sequence[ShapeFigures]) -> ResultTable:
    return ResultTable(
        "lines that are no Gaussians: bound [px]; RMS by the bound, fitted as a Gaussian of any "
        "width, as one with 5 % of error of its shape, and by their own shape",
        ("line", "bound", *(f"RMS {name}" for name in _SHORT.values())),
        tuple(
            (
                _label(shape),
                round(shape.bound_px, 5),
                *(round(shape.errors[name].rms_px / shape.bound_px, 3) for name in _SHORT),
            )
            for shape in shapes
        ),
    )


def _squares(shapes: Sequence[ShapeFigures]) -> ResultTable:
    names = (AS_GAUSSIAN, AS_MEASURED)
    return ResultTable(
        "the same lines: square, and constant offset from the centre of gravity [px]",
        (
            "line", *(f"square {name}" for name in _SHORT.values()),
            *(f"offset {_SHORT[name]}" for name in names),
        ),
        tuple(
            (
                _label(shape),
                *(round(shape.errors[name].nees, 3) for name in _SHORT),
                *(round(shape.errors[name].offset_px, 4) for name in names),
            )
            for shape in shapes
        ),
    )  # fmt: skip


def _knowing(shapes: Sequence[ShapeFigures]) -> ResultTable:
    names = (AS_GAUSSIAN, AS_MEASURED)
    return ResultTable(
        "the same lines: share of poor fits, and peaks seen where four may be",
        (
            "line", *(f"poor {_SHORT[name]}" for name in names),
            *(f"peaks {_SHORT[name]}" for name in names),
        ),
        tuple(
            (
                _label(shape),
                *(round(shape.errors[name].poor, 3) for name in names),
                *(round(shape.errors[name].peaks, 2) for name in names),
            )
            for shape in shapes
        ),
    )  # fmt: skip


def _label(shape: ShapeFigures) -> str:
    return f"{shape.optics.title}, {shape.light:.0e}".replace("+0", "")


def _by_place(positions: Sequence[PlaceFigures]) -> tuple[ResultTable, ResultTable]:
    names = {GAUSSIAN: "Gauss", FROM_MIDDLE: "middle", BY_PLACE: "by place"}
    line = (
        f"a line of {LIGHT:.0f} electrons whose shape changes along the sensor, by its place as a "
        "part of the field, fitted as a Gaussian, by the shape of the middle and by that by place"
    )
    return (
        ResultTable(
            f"{line}: bound [px], RMS by the bound",
            ("place", "bound", *(f"RMS {name}" for name in names.values())),
            tuple(
                (
                    f"{position.field:g}",
                    round(position.bound_px, 5),
                    *(round(position.errors[name].rms_px / position.bound_px, 3) for name in names),
                )
                for position in positions
            ),
        ),
        ResultTable(
            "the same line: offset from the centre of gravity [px]",
            ("place", *(f"offset {name}" for name in names.values())),
            tuple(
                (
                    f"{position.field:g}",
                    *(round(position.errors[name].offset_px, 4) for name in names),
                )
                for position in positions
            ),
        ),
    )


def _place_finding(positions: Sequence[PlaceFigures]) -> str:
    def offset(name: str) -> float:
        return max(abs(position.errors[name].offset_px) for position in positions)

    return (
        "Off the axis, with the slit on the plane face, a line's shape changes along the sensor. "
        f"A Gaussian is up to {offset(GAUSSIAN):.3f} px from its centre of gravity, the shape of "
        f"the middle {offset(FROM_MIDDLE):.3f} px, the shape between two of {NODES} nodes "
        f"(LineSpreadFunction.from_lines) {offset(BY_PLACE):.4f} px, where the bound is "
        f"{positions[-1].bound_px:.4f} px."
    )


def _shape_findings(shapes: Sequence[ShapeFigures]) -> tuple[str, ...]:
    def ratios(name: str) -> list[float]:
        return [shape.errors[name].rms_px / shape.bound_px for shape in shapes]

    offset = max(abs(shape.errors[AS_GAUSSIAN].offset_px) for shape in shapes)
    skewness = max(abs(optical_line(shape.optics).skewness) for shape in shapes)
    peaks = max(shape.errors[AS_GAUSSIAN].peaks for shape in shapes)
    own = [shape.errors[AS_MEASURED] for shape in shapes]
    return (
        (
            f"Lines traced through the lens of section 3.4, read noise {READ_NOISE:g}: fitted by "
            f"their own shape they have {min(ratios(AS_MEASURED)):.3f} to "
            f"{max(ratios(AS_MEASURED)):.3f} of their bound, and squares of "
            f"{min(errors.nees for errors in own):.2f} to "
            f"{max(errors.nees for errors in own):.2f}. A Gaussian of any width has "
            f"{min(ratios(AS_GAUSSIAN)):.2f} to {max(ratios(AS_GAUSSIAN)):.1f}, and a skewed line "
            f"(skewness {skewness:.2f}) lies up to {offset:.2f} px from its centre of gravity, by "
            "an amount that changes with the light."
        ),
        (
            "Where a Gaussian is not the shape and further peaks may be tried, a bright line is "
            f"taken for up to {peaks:.1f} peaks: its misfit is real. Allowing {SHAPE_ERROR:.0%} of "
            "error of the shape does not cure that, and weighs the pixels worse: "
            f"{max(ratios(ALLOWING)):.1f} of the bound at worst. Measure the shape "
            "(LineSpreadFunction.from_cells), or let one peak be fitted (max_joint_peaks = 1)."
        ),
    )
