"""TabulatedOptics: the light lines of points on real sensors, from tables of exact traces."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.footprints import Footprints
from compute.optics.line_optics.exact import Fineness, TracedLines
from compute.optics.line_optics.field import Field, Nodes
from compute.optics.line_optics.line_shape import Blur
from compute.optics.line_optics.line_table import LineTable
from compute.optics.line_optics.quantiles import windows
from compute.optics.line_optics.row_rays import Tracer
from compute.optics.line_optics.sensor import OpticalSensor
from compute.optics.pixel_row import PixelRow
from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.trace import trace_rays

Array = NDArray[np.float64]

TABLE_FINENESS: Final = Fineness(17)
"""Rays of a fan for a table: within 1e-4 px of 257 for the built-in devices."""

_Kind = tuple[Assembly, PixelRow]  # sensors of one kind share a table


class TabulatedOptics:
    """The optics of S sensors by tables of exact traces: for live simulation.

    Points outside of a table's field, and at the edge of what the row can see, are traced.

    Args:
        sensors: the sensors, in the device's order; those of one kind share a table.
        blur: emitter and wavelength.
        field: the part of each sensor's field of view to tabulate.
        nodes: how finely to tabulate.
        fineness: how finely to trace; None: TABLE_FINENESS.
        tracer: what traces; NumPy's by default.
    """

    def __init__(
        self,
        sensors: Sequence[OpticalSensor],
        blur: Blur,
        field: Field,
        nodes: Nodes | None = None,
        fineness: Fineness | None = None,
        tracer: Tracer = trace_rays,
    ) -> None:
        self._sensors = tuple(sensors)
        self._tables: dict[_Kind, LineTable] = {}
        self._of_kind: dict[_Kind, list[int]] = {}
        for number, sensor in enumerate(self._sensors):
            kind = (sensor.assembly, sensor.row)
            self._of_kind.setdefault(kind, []).append(number)
            if kind not in self._tables:
                self._tables[kind] = _table(
                    *kind, blur, fineness or TABLE_FINENESS, tracer, field, nodes
                )

    def footprints(self, points_mm: Array) -> Footprints:
        """Return the footprints of points (N, 3) in the world frame [mm]."""
        count, total = len(points_mm), len(self._sensors)
        levels, light = [], []
        for kind, numbers in self._of_kind.items():
            seen = np.concatenate(
                [self._sensors[number].in_sensor_frame(points_mm) for number in numbers]
            )
            found, strength = self._tables[kind](seen)
            levels.append(found)
            light.append(strength)
        first, window = windows(np.concatenate(levels), np.concatenate(light))
        # The sensors of a kind stand together: back into the device's order.
        order = np.argsort(np.concatenate(list(self._of_kind.values())))
        return Footprints(
            first.reshape(total, count)[order].T,
            window.reshape(total, count, -1)[order].transpose(1, 0, 2),
        )


@lru_cache(maxsize=8)
def _table(
    assembly: Assembly,
    row: PixelRow,
    blur: Blur,
    fineness: Fineness,
    tracer: Tracer,
    field: Field,
    nodes: Nodes | None,
) -> LineTable:
    """Return a table, kept for the next device of the kind: making one takes seconds."""
    return LineTable(TracedLines(assembly, row, blur, fineness, tracer), field, nodes)
