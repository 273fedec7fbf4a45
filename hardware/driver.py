"""The driver protocol: the interface of every source of line scans."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Literal, Protocol, Self, TypeVar, runtime_checkable

from hardware.line_frame import LineFrame

Readout = Literal["lines", "coded-window", "gray-tracks", "bar-peaks"]
"""Content of a scan: stripe images of the markers, the shadow of a coded window, or the outputs of
the detectors behind a plate's Gray tracks. ``bar-peaks``: there are no scans, but the peaks that
other devices have found."""


PeakMethod = Literal["fit", "centroid"]
"""Method of peak detection: a weighted fit of the line spread function, or a threshold and the
centre of gravity."""


@dataclass(frozen=True)
class SensorDescription:
    """One line sensor of a device: its name, number of pixels and pixel pitch [um]."""

    name: str
    pixels: int
    pitch_um: float


@dataclass(frozen=True)
class DeviceDescription:
    """Static properties of a device, known before the first frame.

    Args:
        name: the device's name.
        sensors: the line sensors, in the order of ``LineFrame.lines``; all of one length.
        frame_rate_hz: exposures per second; 0 when not known.
        bits: resolution of the conversion; counts lie in ``[0, 2**bits - 1]``.
        electrons_per_count: gain of the conversion.
        read_noise_electrons: standard deviation of the read noise.
        offset_counts: electronic offset, the count without light.
        markers: number of strobed markers, 0 when the markers are lit together.
        readout: content of a scan.
        peaks: method of peak detection.
        line_sigma_px: standard deviation of Gaussian stripe images, where it is known and the
            same everywhere; None: it is not.
        profile: name of the device profile that describes its optics and detector; None: none.
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
    """A source of line scans: a blocking generator.

    The caller runs it in threads of its own: in one after the other, never in two at a time.
    """

    @property
    def description(self) -> DeviceDescription:
        """The device's properties; valid after ``open``."""
        ...

    @property
    def lossless(self) -> bool:
        """Whether the source waits for its consumer, so that no frame is ever dropped.

        True for a replay as fast as frames are consumed; a live device cannot wait.
        """
        ...

    def open(self) -> None:
        """Connect; raises LumilineError when the device or the file cannot be used."""
        ...

    def frames(self) -> Iterator[LineFrame]:
        """Yield frames until the source ends or ``close`` is called."""
        ...

    def close(self) -> None:
        """Release everything and end ``frames``; may be called from any thread, and twice."""
        ...


@runtime_checkable
class IdlingDriver(Protocol):
    """A driver that need not make pixels while nobody looks at them."""

    idle: bool
    """Whether nobody looks: its frames come with empty ``lines``, numbered and timed as ever."""


@runtime_checkable
class PreparingDriver(Protocol):
    """A driver that has something to do before its first frame, which takes long."""

    preparation: str | None
    """What it does, as a sentence; None: nothing any more. Set by ``open``."""


class Session(Protocol):
    """What a driver holds from ``open`` to ``close``."""

    def close(self) -> None:
        """End the frames and release the device; callable from any thread, and twice."""
        ...


S = TypeVar("S", bound=Session)


class SessionDriver(Generic[S]):
    """Base of drivers whose state from ``open`` to ``close`` is one object."""

    _arguments: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **members: Any) -> Self:
        """Keep the arguments: they are what a driver is pickled as, to be opened elsewhere."""
        made = super().__new__(cls)
        made._arguments = args, members
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what makes a driver like this one, which is not open."""
        args, members = self._arguments
        return partial(type(self), **members), args

    def __init__(self) -> None:
        self._session: S | None = None

    def close(self) -> None:
        """End ``frames`` and release the device; may be called from any thread, and twice."""
        if self._session is not None:
            self._session.close()

    def _opened(self) -> S:
        if self._session is None:
            raise RuntimeError("the driver is not open; call open() first")
        return self._session
