"""Optics of placed sensors by tables of exact ray traces, for live simulation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Final

import numpy as np
from cachetools import FIFOCache
from numpy.typing import NDArray

from compute.optics.pixel_row import PixelRow
from compute.optics.pixel_solid_angles import PixelSolidAngles
from compute.optics.sensor_placement import OpticalSensor
from compute.optics.stripe_optics.stripe_profile import Blur
from compute.optics.stripe_optics.stripe_quantiles import pixel_windows
from compute.optics.stripe_optics.stripe_table import FieldOfView, StripeTable, TableNodes
from compute.optics.stripe_optics.traced_stripes import RaySampling, TracedStripes
from compute.optics.tracing.assembly import Assembly

Array = NDArray[np.float64]

_SAMPLING: Final = RaySampling(17)  # within 1e-4 px of 257 rays for the built-in devices

_Kind = tuple[Assembly, PixelRow]  # sensors of one kind share a table


class TabulatedOptics:
    """Optics of S sensors by tables of exact traces.

    Points outside of a table's field, and at the edge of what the row can see, are traced.

    Args:
        sensors: the sensors, in the device's order; those of one kind share a table.
        blur: emitter and wavelength.
        field: the part of each sensor's field of view to tabulate.
        nodes: how finely to tabulate.
        make_table: makes a table that is not kept from before, which takes seconds.
    """

    def __init__(
        self,
        sensors: Sequence[OpticalSensor],
        blur: Blur,
        field: FieldOfView,
        nodes: TableNodes | None = None,
        make_table: "MakeTable | None" = None,
    ) -> None:
        self._sensors = tuple(sensors)
        self._tables: dict[_Kind, StripeTable] = {}
        self._of_kind: dict[_Kind, list[int]] = {}
        for number, sensor in enumerate(self._sensors):
            kind = (sensor.assembly, sensor.row)
            self._of_kind.setdefault(kind, []).append(number)
            if kind not in self._tables:
                self._tables[kind] = _kept_table(
                    TableRequest(*kind, blur, field, nodes), make_table
                )

    def solid_angles(self, points_mm: Array) -> PixelSolidAngles:
        """Return the solid angles of points (N, 3) in the world frame [mm]."""
        count, total = len(points_mm), len(self._sensors)
        levels, light = [], []
        for kind, numbers in self._of_kind.items():
            local = np.concatenate(
                [self._sensors[number].to_sensor_frame(points_mm) for number in numbers]
            )
            stripe_levels, strength = self._tables[kind](local)
            levels.append(stripe_levels)
            light.append(strength)
        first, window = pixel_windows(np.concatenate(levels), np.concatenate(light))
        # The sensors of a kind stand together: back into the device's order.
        order = np.argsort(np.concatenate(list(self._of_kind.values())))
        return PixelSolidAngles(
            first.reshape(total, count)[order].T,
            window.reshape(total, count, -1)[order].transpose(1, 0, 2),
        )


@dataclass(frozen=True)
class TableRequest:
    """What a table is made of.

    Args:
        assembly: the lenses.
        row: the pixels.
        blur: emitter and wavelength.
        field: the part of the field of view to tabulate.
        nodes: how finely.
    """

    assembly: Assembly
    row: PixelRow
    blur: Blur
    field: FieldOfView
    nodes: TableNodes | None = None


MakeTable = Callable[[TableRequest], StripeTable]

_KEPT: Final = 8
_tables: FIFOCache[TableRequest, StripeTable] = FIFOCache(_KEPT)
_tables_lock: Final = Lock()


def make_table(request: TableRequest) -> StripeTable:
    """Trace a table; takes seconds."""
    lines = TracedStripes(request.assembly, request.row, request.blur, _SAMPLING)
    return StripeTable(lines, request.field, request.nodes)


def _kept_table(request: TableRequest, make: MakeTable | None) -> StripeTable:
    """Return a table, kept for the next device of the kind."""
    with _tables_lock:
        found = _tables.get(request)
    if found is None:
        found = (make or make_table)(request)
        with _tables_lock:
            _tables[request] = found
    return found
