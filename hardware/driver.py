"""The driver protocol: what every source of line scans offers to the core."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

from hardware.line_frame import LineFrame

Readout = Literal["lines", "coded-window", "gray-tracks"]
"""What the pixels of a line show: images of the markers as lines of light, the shadow of a coded
window, or the outputs of the detectors behind a plate's Gray tracks."""


PeakMethod = Literal["fit", "centroid"]
"""How the peaks of light lines are measured: by a weighted fit of the line's shape, or by threshold
and centre of gravity."""


@dataclass(frozen=True)
class SensorDescription:
    """One line sensor of a device: its name, number of pixels and pixel pitch [um]."""

    name: str
    pixels: int
    pitch_um: float


@dataclass(frozen=True)
class DeviceDescription:
    """What a device is, as its driver knows it before the first frame.

    Args:
        name: the device's name.
        sensors: the line sensors, in the order of ``LineFrame.lines``; all of one length.
        frame_rate_hz: exposures per second; 0 when not known.
        bits: resolution of the conversion; counts lie in ``[0, 2**bits - 1]``.
        electrons_per_count: gain of the conversion.
        read_noise_electrons: standard deviation of the read noise.
        offset_counts: electronic offset, the count without light.
        markers: number of strobed markers, 0 when the markers are lit together.
        readout: what the pixels of a line show.
        peaks: how the peaks of light lines are measured; nothing else reads by it.
        line_sigma_px: standard deviation of all light lines, where they are Gaussian and it is
            known; None: it is not, or differs from place to place.
        profile: name of the device's profile, from which more is known of its lines; None: none.
    """

    name: str
    sensors: tuple[SensorDescription, ...]
    frame_rate_hz: float
    bits: int
    electrons_per_count: float
    read_noise_electrons: float
    offset_counts: float
    markers: int
    readout: Readout = "lines"
    peaks: PeakMethod = "fit"
    line_sigma_px: float | None = None
    profile: str | None = None


class Driver(Protocol):
    """A source of line scans: a blocking generator; the core owns the thread that runs it."""

    @property
    def description(self) -> DeviceDescription:
        """What the device is; valid after ``open``."""
        ...

    def open(self) -> None:
        """Connect; raises LumilineError when the device or the file cannot be used."""
        ...

    def frames(self) -> Iterator[LineFrame]:
        """Yield frames as they are exposed, until the source ends or ``close`` is called."""
        ...

    def close(self) -> None:
        """Release everything and end ``frames``; may be called from any thread, and twice."""
        ...
