"""Settings of the serial driver."""

import re
from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field

from compute.errors import InvalidParameter
from hardware.driver import PeakMethod
from hardware.field_bounds import CheckedSettings
from hardware.strobe_schedule import StrobeSchedule

_HOST: Final = r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?"
URL_PATTERN: Final = (
    r"^(/dev/(tty|cu\.|lumiline)[A-Za-z0-9._-]*|/dev/pts/[0-9]+"
    r"|/dev/serial/by-(id|path)/[A-Za-z0-9][A-Za-z0-9._:+-]*|COM[0-9]+"
    rf"|(socket|rfc2217)://{_HOST}:[0-9]{{1,5}})$"
)
"""Serial ports by their usual names, and by network: nothing else of the host is opened."""


PortUrl = Annotated[str, Field(pattern=URL_PATTERN, max_length=200)]


def check_port_url(**url: str) -> None:
    """Raise InvalidParameter where a field's value is not the URL of a serial port."""
    ((name, value),) = url.items()
    if re.fullmatch(URL_PATTERN, value) is None:
        raise InvalidParameter(
            f"{name} is {value!r:.100}; it must be a serial port as /dev/ttyACM0 or COM3, "
            "socket://HOST:PORT or rfc2217://HOST:PORT",
            **url,
        )


@dataclass(frozen=True)
class SerialSettings(CheckedSettings):
    """Port of a device, and settings sent to it.

    Args:
        url: its port: ``/dev/ttyACM0``, ``/dev/serial/by-id/...``, ``COM3``,
            ``socket://host:port`` or ``rfc2217://host:port``. A name of one's own, from a rule of
            udev, begins with ``/dev/lumiline``.
        baudrate: bits per second of a line that has them; USB has none, and networks.
        silent_after_s: time without frames after which the device counts as silent, at least
            three exposures [s].
        frame_rate_hz: exposures per second; None: the device's own.
        exposure_us: their duration [us]; None: the device's own.
        strobe: the strobe schedule; None: the device's own.
        peaks: how the lines' peaks are measured.

    Raises:
        InvalidParameter: a value is outside of its bounds, or the URL is none.
    """

    url: PortUrl
    baudrate: Annotated[int, Field(ge=300, le=20_000_000)] = 921_600
    silent_after_s: Annotated[float, Field(ge=0.05, le=60.0)] = 1.0
    frame_rate_hz: Annotated[float, Field(gt=0.0, le=100_000.0)] | None = None
    exposure_us: Annotated[float, Field(gt=0.0, le=1e7)] | None = None
    strobe: StrobeSchedule | None = None
    peaks: PeakMethod = "fit"

    def __post_init__(self) -> None:
        check_port_url(url=self.url)
        super().__post_init__()
