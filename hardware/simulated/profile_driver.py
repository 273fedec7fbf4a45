"""ProfileDriver: driver of a device simulated from its profile."""

import logging
from dataclasses import replace
from functools import cached_property, partial
from threading import Event
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.detector_array import DetectorArray
from compute.optics.pixel_solid_angles import SolidAngleOptics, scan_electrons
from compute.optics.profiles.device_profile import DeviceProfile, PlateOptics
from compute.optics.profiles.profile_optics import (
    lens_sensors,
    light_source,
    mask_optics,
    pixel_row,
    profile_optics,
)
from compute.optics.sensor_placement import to_optics_frame
from compute.optics.stripe_optics.tabulated_optics import MakeTable
from hardware.driver import DeviceDescription, Readout, SensorDescription
from hardware.simulated.driver import RenderedDriver
from hardware.simulated.frame_batch import Renderer, Timing
from hardware.simulated.profile_settings import ProfileSettings
from hardware.simulated.scenes import EvenLight
from hardware.simulated.tracing_process import TracingCancelled, table_in_process


class ProfileDriver(RenderedDriver):
    """Simulated device with the optics, light and detector of a profile.

    Args:
        name: the device's name.
        profile: the device.
        settings: what it shows; see ``ProfileSettings``.

    Raises:
        InvalidParameter: the frame rate is above the profile's line rate.
    """

    def __init__(self, name: str, profile: DeviceProfile, settings: ProfileSettings) -> None:
        timing = Timing(
            settings.rate_of(profile),
            settings.strobed_in(profile),
            settings.duration_s,
            settings.realtime,
        )
        detector = profile.detector
        description = DeviceDescription(
            name=name,
            sensors=tuple(
                SensorDescription(sensor.name, profile.pixels.count, profile.pixels.pitch_um)
                for sensor in profile.sensors
            ),
            frame_rate_hz=timing.frame_rate_hz,
            bits=detector.bits,
            electrons_per_count=detector.electrons_per_count,
            read_noise_electrons=detector.read_noise_electrons,
            offset_counts=detector.offset_counts,
            markers=timing.strobed_markers,
            readout=readout_of(profile),
            peaks=settings.peaks,
            profile=profile.name,
        )
        self._profile_renderer = ProfileRenderer(profile, settings, timing)
        super().__init__(description, self._profile_renderer, timing)
        self._traces = settings.realtime and settings.optics == "tabulated"
        self.preparation: str | None = None
        """See PreparingDriver."""

    def open(self) -> None:
        """As of every driver; its optics are traced by ``frames``."""
        super().open()
        if self._traces and self.description.readout != "coded-window":
            self.preparation = (
                "the optics of its profile are being traced; its exposures begin in ten seconds or "
                "more"
            )

    def _prepare(self, closed: Event) -> None:
        """Trace the optics in a process of their own: a live device runs beside others."""
        try:
            if self._traces:
                self._profile_renderer.trace(closed)
        except TracingCancelled:
            pass
        finally:
            self.preparation = None


def readout_of(profile: DeviceProfile) -> Readout:
    """Return the content of a scan of the profile's sensors."""
    kinds = {type(one) for one in profile.optics.values()}
    if CodedWindow in kinds:
        return "coded-window"
    return "gray-tracks" if PlateOptics in kinds else "lines"


_log = logging.getLogger(__name__)

_FIELD_SAMPLES: Final = 181  # at a scene's period


class ProfileRenderer(Renderer):
    """Renders exposures of a profile's device; markers face every sensor.

    The optics are traced for the first batch.

    Args:
        profile: the device.
        settings: what it shows.
        timing: when its exposures are made.
    """

    def __init__(self, profile: DeviceProfile, settings: ProfileSettings, timing: Timing) -> None:
        self._profile = profile
        self._settings = settings
        self._timing = timing
        self._scene = settings.scene_in(profile)
        self._source = light_source(profile)
        self._check_scene()
        self._lenses_mm = np.array([sensor.position_mm for sensor in profile.sensors])
        detector = profile.detector.detector(profile.rates.exposure_s)
        if isinstance(self._scene, EvenLight):
            detector = replace(detector, ambient_electrons=self._scene.electrons)
        pixels = DetectorArray(
            detector,
            len(profile.sensors),
            profile.pixels.count,
            pattern_seed=settings.pattern_seed,
        )
        super().__init__(pixels, detector.full_counts, settings.seed)

    def _check_scene(self) -> None:
        """Raise InvalidParameter where a scene runs through a sensor's lenses."""
        if isinstance(self._scene, EvenLight):
            return
        if mask_optics(self._profile, self._source) is not None:
            return
        # One period shows a whole motion; scenes at rest have none.
        period = getattr(self._scene, "period_s", 1.0)
        points = self._scene.points(np.linspace(0.0, period, _FIELD_SAMPLES)).reshape(-1, 3)
        for sensor in lens_sensors(self._profile, pixel_row(self._profile)):
            try:
                sensor.assembly.check_source(to_optics_frame(sensor.to_sensor_frame(points)))
            except InvalidParameter as error:
                raise InvalidParameter(
                    f"scene runs through the optics of sensor {sensor.name}: {error.detail}",
                    scene=self._scene.kind,
                ) from None

    @cached_property
    def _optics(self) -> SolidAngleOptics:
        return self._traced(None)

    def trace(self, cancelled: Event) -> None:
        """Trace the optics in a process of their own, unless they are kept from before.

        Raises:
            TracingCancelled: the event was set meanwhile.
        """
        if not isinstance(self._scene, EvenLight):
            # Before anybody asks for the property.
            self.__dict__["_optics"] = self._traced(partial(table_in_process, cancelled=cancelled))

    def _traced(self, make_table: MakeTable | None) -> SolidAngleOptics:
        name = self._profile.name
        _log.info("profile %s: tracing its optics, seconds before the first frame", name)
        optics = profile_optics(self._profile, self._settings.optics, make_table)
        _log.info("profile %s: its optics are traced", name)
        return optics

    def signal_electrons(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the mean electrons of the markers in N exposures, shape (N, sensors, pixels)."""
        if isinstance(self._scene, EvenLight):
            shape = (len(sequence), len(self._profile.sensors), self._profile.pixels.count)
            return np.zeros(shape)
        points = self._timing.lit(self._scene.points(self._timing.time_s(sequence)), sequence)
        flat = points.reshape(-1, 3)
        photons = self._source.photons_per_sr(
            flat, None, self._lenses_mm, self._profile.rates.exposure_s
        )
        return scan_electrons(
            self._optics.solid_angles(flat),
            photons * self._profile.detector.quantum_efficiency,
            points.shape[1],
            self._profile.pixels.count,
        )
