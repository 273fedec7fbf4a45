"""One wrong or exchanged label, and how sure that is."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class LabelFinding:
    """A reading that cannot be its point's, or an exchange that mends two.

    Args:
        kind: "wrong": the reading fits no other point. "exchanged": the readings of two points
            belong to one another.
        sensor: the sensor's name; None: the points themselves are exchanged, for all sensors.
        points: the points concerned, counted from 1: one or two.
        probability: how sure that is, 0 .. 1.
    """

    kind: Literal["wrong", "exchanged"]
    sensor: str | None
    points: tuple[int, ...]
    probability: float
