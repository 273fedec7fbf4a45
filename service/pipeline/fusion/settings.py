"""FusionSettings, FusedBar: what a fused device is made of, and how its bars are put together."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from hardware.driver import SensorDescription
from hardware.field_bounds import CheckedSettings


@dataclass(frozen=True)
class FusionSettings(CheckedSettings):
    """How the frames of several bars are put together.

    Args:
        max_wait_ms: how long a frame waits for readings of the other bars [ms].
        clock_uncertainty_us: standard deviation of the difference of any two bars' clocks, beyond
            what their drivers state of them [us]: shortest delays, of which no driver knows. It is
            refined from markers that move.

    Raises:
        InvalidParameter: a value is outside of its bounds.
    """

    max_wait_ms: Annotated[float, Field(ge=0.0, le=10_000.0)] = 50.0
    clock_uncertainty_us: Annotated[float, Field(ge=0.0, le=10_000.0)] = 50.0


@dataclass(frozen=True)
class FusedBar:
    """One bar of a fused device.

    Args:
        device_id: the bar's device.
        sensors: its sensors, as they are stored.
    """

    device_id: str
    sensors: tuple[SensorDescription, ...]
