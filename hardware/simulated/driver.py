"""Driver of simulated devices, with a clock and a FIFO of limited length."""

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from threading import Event
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector import Detector
from compute.optics.ideal_optics import IdealOptics
from compute.optics.pixel_solid_angles import stripe_images
from hardware.clock_sync import HostClock, wait_until
from hardware.driver import DeviceDescription, SensorDescription
from hardware.line_frame import FrameFlag, LineFrame
from hardware.simulated.frame_batch import BATCH, Renderer, Timing
from hardware.simulated.pixel_defects import DefectiveDetector
from hardware.simulated.placement import DAY_NS, BarPlacement
from hardware.simulated.scenes import EvenLight
from hardware.simulated.settings import SimulationSettings
from hardware.simulated.simulated_rig import PIXELS, WORKING_CENTRE_MM, simulated_rig

IDLE_BURST_S: Final = 0.05
"""Frames without pixels come in such bursts: a wake-up for each costs a tenth of a core."""
_NO_PIXELS: Final = np.empty((0, 0), dtype=np.uint16)
FIFO_S: Final = 1.0
"""Length of the device's FIFO; older exposures that were not fetched are lost."""


class RenderedDriver:
    """A driver whose frames are rendered.

    The device starts exposing, and its clock at zero, at the first call of ``frames``. In real
    time a frame is delivered at the centre of its exposure, whose host time is read from the
    host's clock; a late host finds at most FIFO_S of frames, the first of them flagged OVERFLOW
    after a gap in the sequence numbers. Otherwise the driver loses nothing, and host times
    follow the device's clock from the start.

    Args:
        description: the device's properties.
        renderer: renders its exposures.
        timing: when it makes them.
        placement: of the bar in a hall, by whose time it exposes; None: by its own.
    """

    lossless = False

    def __init__(
        self,
        description: DeviceDescription,
        renderer: Renderer,
        timing: Timing,
        placement: BarPlacement | None = None,
    ) -> None:
        self._placement = placement
        self._description = description
        self._renderer = renderer
        self._timing = timing
        self._fifo_frames = max(2, math.ceil(FIFO_S * timing.frame_rate_hz))
        self._closed: Event | None = None
        self.idle = False
        """Whether nobody looks at the pixels, which are not rendered then; see IdlingDriver."""

    @property
    def description(self) -> DeviceDescription:
        """The device's properties."""
        return self._description

    def open(self) -> None:
        """Open the device; ``frames`` begins again at sequence number zero."""
        self.close()
        self._closed = Event()

    def close(self) -> None:
        """End ``frames`` at once; may be called from any thread, and twice."""
        if self._closed is not None:
            self._closed.set()

    def frames(self) -> Iterator[LineFrame]:
        """Yield frames until the scene ends or ``close`` is called.

        Raises:
            RuntimeError: the driver was never opened.
        """
        closed = self._closed
        if closed is None:
            raise RuntimeError("the driver is not open; call open() before frames()")
        return self._run(closed)

    def _prepare(self, closed: Event) -> None:
        """Do what the first frame needs; ends soon after ``closed`` is set."""

    def _run(self, closed: Event) -> Iterator[LineFrame]:
        self._prepare(closed)
        if closed.is_set():
            return
        number = 0
        batch = self._renderer.batch(number)  # before the first exposure, which is then in time
        start_host_ns, start_ns = self._begin()
        if self._placement is not None:
            self._renderer.begin_s = 1e-9 * (start_host_ns % DAY_NS)
            batch = self._renderer.batch(number)
        host_clock = HostClock()
        sequence, end = 0, self._timing.frames
        burst = max(1, round(IDLE_BURST_S * self._timing.frame_rate_hz))
        while (end is None or sequence < end) and not closed.is_set():
            flags = FrameFlag.NONE
            if self._timing.realtime:
                oldest = self._exposed(time.monotonic_ns() - start_ns) - self._fifo_frames
                if oldest > sequence:
                    sequence, flags = oldest, FrameFlag.OVERFLOW
            rendered = not (self.idle and self._timing.realtime)
            if rendered and number != sequence // BATCH:
                number = sequence // BATCH
                batch = self._renderer.batch(number)
            device_ns = self._timing.time_ns(sequence)
            host_ns = start_host_ns + device_ns
            if self._timing.realtime:
                due_ns = start_ns + device_ns
                if rendered or sequence % burst == 0:
                    last = sequence if rendered else sequence + burst - 1
                    wait_until(start_ns + self._timing.time_ns(last), closed)
                _, host_ns = host_clock.convert(due_ns)
                if closed.is_set():
                    return
            index = sequence % BATCH
            if rendered and batch.saturated[index]:
                flags |= FrameFlag.SATURATED
            yield LineFrame(
                device=self._description.name,
                sequence=sequence,
                exposure_device_ns=device_ns,
                exposure_host_ns=host_ns,
                marker=self._timing.marker(sequence),
                lines=batch.lines[index] if rendered else _NO_PIXELS,
                flags=flags,
            )
            sequence += 1

    def _begin(self) -> tuple[int, int]:
        """Return when the exposures begin, on the host's clock and on the monotonic one [ns]."""
        if self._placement is None:
            return time.time_ns(), time.monotonic_ns()
        timing = self._timing
        slots = len(timing.schedule) or max(timing.strobed_markers, 1)
        return self._placement.begin(slots / timing.frame_rate_hz)

    def _exposed(self, elapsed_ns: int) -> int:
        """Return the number of exposures made in a time since the start."""
        exposed = math.floor(elapsed_ns * 1e-9 * self._timing.frame_rate_hz + 0.5)
        end = self._timing.frames
        return exposed if end is None else min(exposed, end)


class SimulatedDriver(RenderedDriver):
    """Simulated bar of four line sensors with ideal lenses.

    Args:
        name: the device's name.
        settings: the simulation; see ``SimulationSettings``.
    """

    def __init__(self, name: str, settings: SimulationSettings) -> None:
        description = DeviceDescription(
            name=name,
            sensors=tuple(
                SensorDescription(sensor.model.name, sensor.model.pixels, sensor.pitch_um)
                for sensor in simulated_rig()
            ),
            frame_rate_hz=settings.frame_rate_hz,
            bits=settings.bits,
            electrons_per_count=settings.electrons_per_count,
            read_noise_electrons=settings.read_noise_electrons,
            offset_counts=settings.offset_counts,
            markers=settings.strobed_markers,
            peaks=settings.peaks,
            line_sigma_px=settings.spot_sigma_px,
        )
        super().__init__(description, FrameRenderer(settings), settings.timing, settings.placement)


class FrameRenderer(Renderer):
    """Renders exposures of a simulation with ideal optics.

    Args:
        settings: the simulation.
    """

    def __init__(self, settings: SimulationSettings) -> None:
        self._settings = settings
        self._optics = IdealOptics(
            simulated_rig(),
            spot_sigma_px=settings.spot_sigma_px,
            signal_electrons=settings.signal_electrons,
            reference_distance_mm=WORKING_CENTRE_MM[2] if settings.distance_falloff else None,
        )
        detector = Detector(
            bits=settings.bits,
            electrons_per_count=settings.electrons_per_count,
            offset_counts=settings.offset_counts,
            read_noise_electrons=settings.read_noise_electrons,
            full_well_electrons=settings.full_well_electrons,
            ambient_electrons=(
                settings.scene.electrons
                if isinstance(settings.scene, EvenLight)
                else settings.ambient_electrons
            ),
        )
        pixels: Detector | DefectiveDetector = detector
        if settings.pixels is not None:
            differing = replace(
                detector,
                response_nonuniformity=settings.pixels.response_nonuniformity,
                offset_nonuniformity_counts=settings.pixels.offset_nonuniformity_counts,
            )
            sensors = len(simulated_rig())
            pixels = DefectiveDetector(differing, sensors, PIXELS, settings.pixels)
        super().__init__(pixels, detector.full_scale, settings.seed)

    def signal_electrons(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the mean electrons of the markers in N exposures, shape (N, sensors, pixels)."""
        timing = self._settings.timing
        if isinstance(self._settings.scene, EvenLight):
            return np.zeros((len(sequence), len(simulated_rig()), PIXELS))
        time_s = timing.time_s(sequence) + self.begin_s
        points = timing.lit(self._settings.scene.points(time_s), sequence)
        if self._settings.placement is not None:
            points = self._settings.placement.in_bar(points)
        frames, markers, _ = points.shape
        spots = self._optics.stripes(points.reshape(-1, 3))
        sensors = spots.position_px.shape[1]
        electrons = spots.electrons
        if self._settings.blink is not None:
            electrons = electrons * self._settings.blink.light(sequence).reshape(-1, 1)

        def by_line(values: NDArray[np.float64]) -> NDArray[np.float64]:
            per_frame = values.reshape(frames, markers, sensors)
            return per_frame.transpose(0, 2, 1).reshape(frames * sensors, markers)

        signal = stripe_images(
            by_line(spots.position_px), by_line(spots.sigma_px), by_line(electrons), PIXELS
        )
        return signal.reshape(frames, sensors, PIXELS)
