"""The strobe schedule: which marker is lit in which exposure, by time division.

Markers that are lit one at a time identify themselves, and no two of them meet on a sensor
(thesis, chapter 6, Time Division Identification); each of N is seen at the line rate over N
(equation 3.3).
"""

from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field

from hardware.field_bounds import FIRST_ERROR_ONLY, CheckedSettings

MAX_SLOTS: Final = 254
MAX_MARKERS: Final = 254


@dataclass(frozen=True)
class StrobeSchedule(CheckedSettings):
    """A cyclic sequence of slots, one exposure each; each slot lights one marker, or all.

    Args:
        slots: the number of the marker that is lit in each, from 0; None: all are.

    Raises:
        InvalidParameter: no slots, too many, or a marker that cannot be.
    """

    slots: Annotated[
        tuple[Annotated[int, Field(ge=0, lt=MAX_MARKERS)] | None, ...],
        Field(
            min_length=1,
            max_length=MAX_SLOTS,
            description="The marker that is lit in each exposure, from 0; null: all are.",
        ),
        FIRST_ERROR_ONLY,
    ]

    @property
    def markers(self) -> int:
        """Number of strobed markers the schedule needs; 0: all are always lit together."""
        return 1 + max((slot for slot in self.slots if slot is not None), default=-1)
