"""Line spread function in requests: measured or traced, used by the fit."""

from functools import cached_property
from typing import Annotated, Final

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import MAX_PIXELS
from compute.signal.fit.fit_settings import WIDTH_LIMITS_PX
from compute.signal.fit.line_spread_function import LineSpreadFunction
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.line_scans.chain_steps import STRICT

MAX_NODES: Final = 256
MAX_CELLS: Final = 4096
MAX_VALUES: Final = 65536

Place = Annotated[float, Field(ge=-MAX_PIXELS, le=MAX_PIXELS)]
Step = Annotated[float, Field(ge=1e-3, le=MAX_PIXELS)]
Light = Annotated[float, Field(ge=0.0, le=1e12)]


@checked_dataclass(frozen=True, config=STRICT)
class Shape:
    """Light of a line in cells finer than pixels, at one place or several along the sensor."""

    light: Annotated[
        list[Annotated[list[Light], Field(min_length=3, max_length=MAX_CELLS), FIRST_ERROR_ONLY]],
        Field(
            min_length=1,
            max_length=MAX_NODES,
            description="One row of cells for each place along the sensor, all of one length; in "
            "any unit. The first and last cells should hold next to nothing.",
        ),
        FIRST_ERROR_ONLY,
    ]
    first_px: Annotated[
        Place,
        Field(description="Left edge of the first cell [px]; 0 is what a line's position means."),
    ]
    step_px: Annotated[Step, Field(description="Width of a cell [px]; 1/16 is fine enough.")]
    first_node_px: Annotated[
        Place, Field(description="Place along the sensor of the first row [px].")
    ] = 0.0
    node_step_px: Annotated[
        Step, Field(description="From one row's place to the next's [px]; between two, both count.")
    ] = 1.0

    @cached_property
    def width_px(self) -> float:
        """Standard deviation of the light about its centre, RMS over the rows [px].

        Raises:
            InvalidParameter: rows of different lengths, too many values, a row without light, or
                a width that the fit has none for.
        """
        cells = self._cells()
        place = self.step_px * np.arange(cells.shape[1])
        share = cells / cells.sum(axis=1, keepdims=True)
        mean = share @ place
        width = float(np.sqrt(np.mean(share @ place**2 - mean**2)))
        low, high = WIDTH_LIMITS_PX
        if not low <= width <= high:
            raise InvalidParameter(
                f"method.shape has a standard deviation of {width:.3g} px; it must be {low} to "
                f"{high} px",
                width_px=width,
            )
        return width

    @cached_property
    def line_shape(self) -> LineSpreadFunction:
        """Compute's form of it; raises InvalidParameter."""
        return LineSpreadFunction.from_cells(
            self._cells()[None],
            self.first_px,
            self.step_px,
            self.first_node_px,
            self.node_step_px,
            unit_px=self.width_px,
        )

    def _cells(self) -> np.ndarray:
        lengths = {len(row) for row in self.light}
        if len(lengths) > 1:
            raise InvalidParameter(
                f"method.shape.light has rows of {min(lengths)} and of {max(lengths)} cells; all "
                "must be of one length",
                lengths=sorted(lengths),
            )
        values = len(self.light) * lengths.pop()
        if values > MAX_VALUES:
            raise InvalidParameter(
                f"method.shape.light has {values} values; it may have {MAX_VALUES}", values=values
            )
        cells = np.array(self.light)
        dark = np.flatnonzero(cells.sum(axis=1) <= 0.0)
        if len(dark):
            raise InvalidParameter(
                f"method.shape.light.{dark[0]} has no light; each row must have some",
                row=int(dark[0]),
            )
        return cells
