"""A line sensor as clients give it."""

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as checked_dataclass

from hardware.driver import SensorDescription
from service.api.base_models import Name


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class Sensor(SensorDescription):
    """One line sensor: name, number of pixels, pixel pitch [um]."""

    name: Name
    pixels: Annotated[int, Field(ge=8, le=65536)]
    pitch_um: Annotated[float, Field(gt=0, le=1000, description="Pixel pitch [um].")]
