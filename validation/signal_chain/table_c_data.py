"""Data of Tables C.1 to C.4: positions of one LED by thirteen filters."""

import csv
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.signal.thesis_pipeline.filters import ButterworthFilter, FirFilter, MedianFilter
from compute.signal.thesis_pipeline.steps import Compensation, ScanFilter

Array = NDArray[np.float64]
Interval = Literal["C.1", "C.2", "C.3", "C.4"]

MEDIANS: Final = ("median3", "median4", "median7", "median8")
BUTTERWORTHS: Final = ("butter4_0.6", "butter4_0.4", "butter11_0.6", "butter11_0.4")
FIRS: Final = ("fir4_0.6", "fir4_0.4", "fir11_0.6", "fir11_0.4")
FILTERS: Final = (*MEDIANS, *BUTTERWORTHS, *FIRS)

PUBLISHED_DELAYS_PX: Final = {
    # Section 4.2.2: FIR by [B.8], Butterworth by the linearised phase.
    "fir4_0.6": 1.5, "fir4_0.4": 1.5, "fir11_0.6": 5.0, "fir11_0.4": 5.0,
    "butter4_0.6": 1.9, "butter4_0.4": 2.3, "butter11_0.6": 5.1, "butter11_0.4": 6.3,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Column:
    """One filter's column of a table.

    Args:
        position_mm: where the LED was, shape (N,).
        peak_px: the pixel of the maximum, shape (N,).
        centroid_px: the centre of gravity, shape (N,).
    """

    position_mm: Array
    peak_px: Array
    centroid_px: Array


@cache
def columns(table: Interval) -> dict[str, Column]:
    """Return the columns of a table, "raw" first."""
    text = (files("validation") / "data" / "table_C_linear_resolution.csv").read_text("utf-8")
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for row in csv.DictReader(text.splitlines()):
        if row["table"] == table:
            values = (float(row["position_mm"]), float(row["peak_px"]), float(row["centroid_px"]))
            rows.setdefault(row["filter"], []).append(values)
    return {name: Column(*np.array(values).T) for name, values in rows.items()}


def filter_named(name: str, compensation: Compensation) -> ScanFilter | None:
    """Return the filter of a column; None for "raw". A median's phase is its delay."""
    if name == "raw":
        return None
    if name.startswith("median"):
        return MedianFilter(
            int(name.removeprefix("median")), "none" if compensation == "none" else "delay"
        )
    kind, cutoff = name.split("_")
    if kind.startswith("butter"):
        return ButterworthFilter(int(kind.removeprefix("butter")), float(cutoff), compensation)
    return FirFilter(int(kind.removeprefix("fir")) + 1, float(cutoff), compensation)


def delays_px(name: str) -> tuple[float, float | None]:
    """Return a filter's shift, and its delay by the phase's line, None for a median [px]."""
    found = filter_named(name, "none")
    linearised = None
    if isinstance(found, ButterworthFilter):
        linearised = linearised_delay_px(found)
    elif isinstance(found, FirFilter):
        linearised = found.delay_px
    return (0.0 if found is None else found.shift_px), linearised


def linearised_delay_px(found: ButterworthFilter) -> float:
    """Return the delay by the slope of the phase over the pass band, as the thesis takes it [px].

    [B.13], section 4.2.2 and Figure 4.10: a straight line is fitted to the phase by least squares
    from zero to the cut-off, its intercept free. It is no scan's shift: the light is at low
    frequencies.
    """
    omega = np.linspace(0.0, np.pi * found.cutoff, 4001)
    phase = np.unwrap(np.angle(found.response(omega)))
    centred = omega - omega.mean()
    return float(-(centred @ phase) / (centred @ centred))
