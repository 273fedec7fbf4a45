"""Settings of the TCD1304 driver."""

from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field

from hardware.driver import PeakMethod
from hardware.field_bounds import FIRST_ERROR_ONLY, CheckedSettings, SensorName, check_distinct
from hardware.serial.settings import PortUrl, check_port_url
from hardware.tcd1304.protocol import (
    CLOCK_HZ,
    RESPONSE_BYTES,
    Request,
    request_for,
)
from hardware.tcd1304.response import OFFSET_COUNTS

_BITS_OF_BYTE: Final = 10  # start, 8 data, stop


@dataclass(frozen=True)
class Tcd1304Board(CheckedSettings):
    """One board: the sensor's name, and where its serial port is."""

    name: SensorName
    port: PortUrl

    def __post_init__(self) -> None:
        check_port_url(port=self.port)
        super().__post_init__()


@dataclass(frozen=True)
class Tcd1304Settings(CheckedSettings):
    """The boards, and how their lines are taken.

    Args:
        boards: one for each sensor.
        exposure_us: length of one exposure [us], in steps of one period of the master clock.
        averages: exposures that a board averages into one line.
        clock_hz: the master clock of the boards' firmware [Hz].
        baud_rate: the serial ports' rate.
        gap_ms: silence that ends an answer [ms]; longer than any pause on the way.
        saturated_at: the converter's count at which, and below, a pixel is full; dark is high.
        electrons_per_count: gain of the conversion, an estimate; it weighs the noise.
        read_noise_electrons: standard deviation of the read noise, likewise.
        peaks: how the lines' peaks are measured.

    Raises:
        InvalidParameter: a value is out of its bounds, or two boards have one name or one port.
    """

    boards: Annotated[
        tuple[Tcd1304Board, ...], Field(min_length=1, max_length=16), FIRST_ERROR_ONLY
    ]
    exposure_us: Annotated[float, Field(ge=10.0, le=6e7)] = 7388.0
    averages: Annotated[int, Field(ge=1, le=255)] = 1
    clock_hz: Annotated[int, Field(ge=800_000, le=4_000_000)] = CLOCK_HZ
    baud_rate: Annotated[int, Field(ge=9600, le=4_000_000)] = 115_200
    gap_ms: Annotated[float, Field(ge=1.0, le=500.0)] = 50.0
    saturated_at: Annotated[int, Field(ge=0, le=4094)] = 0
    electrons_per_count: Annotated[float, Field(ge=0.5, le=1e4)] = 30.0
    read_noise_electrons: Annotated[float, Field(ge=0.0, le=500.0)] = 75.0
    peaks: PeakMethod = "fit"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_distinct(self.boards, "boards", "name", "port")
        _ = self.request  # raises where the board would not do it

    @property
    def request(self) -> Request:
        """The request sent to every board."""
        return request_for(self.exposure_us, self.averages, self.clock_hz)

    @property
    def transfer_s(self) -> float:
        """Transfer time of a response [s]."""
        return RESPONSE_BYTES * _BITS_OF_BYTE / self.baud_rate

    @property
    def frame_rate_hz(self) -> float:
        """Approximate rate of consecutive requests [Hz]."""
        wait_s = self.request.max_wait_ns * 1e-9
        return 1.0 / (wait_s + self.transfer_s + self.gap_ms * 1e-3)

    @property
    def offset_counts(self) -> float:
        """The count without light."""
        return float(OFFSET_COUNTS)
