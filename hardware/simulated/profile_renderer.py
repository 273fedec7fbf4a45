"""Renders frames of a profile's device in batches: scene, light, traced optics, detector."""

import logging
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.detector_array import DetectorArray
from compute.optics.pixel_solid_angles import SolidAngleOptics, scan_electrons
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_optics import (
    lens_sensors,
    light_source,
    mask_optics,
    pixel_row,
    profile_optics,
)
from compute.optics.stripe_optics.optical_sensor import to_optics_frame
from hardware.simulated.frame_batch import Batch, Timing, batch_rng, batch_sequence, frame_batch
from hardware.simulated.profile_settings import ProfileSettings

_log = logging.getLogger(__name__)

_FIELD_SAMPLES: Final = 181  # at a scene's period


class ProfileRenderer:
    """Renders exposures of a profile's device by number; markers face every sensor.

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
        self._full_counts = detector.full_counts
        self._detector = DetectorArray(
            detector,
            len(profile.sensors),
            profile.pixels.count,
            pattern_seed=settings.pattern_seed,
        )

    def _check_scene(self) -> None:
        """Raise InvalidParameter where a scene runs through a sensor's lenses."""
        if mask_optics(self._profile, self._source) is not None:
            return
        # A turn of the bar lasts as long as its period; what is still is so at all times.
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
        name = self._profile.name
        _log.info("profile %s: tracing its optics, seconds before the first frame", name)
        optics = profile_optics(self._profile, self._settings.optics)
        _log.info("profile %s: its optics are traced", name)
        return optics

    def signal_electrons(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the mean electrons of the markers in N exposures, shape (N, sensors, pixels)."""
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

    def batch(self, number: int) -> Batch:
        """Render exposures ``BATCH * number`` to ``BATCH * (number + 1) - 1``."""
        signal = self.signal_electrons(batch_sequence(number))
        lines = self._detector.expose(signal, batch_rng(self._settings.seed, number))
        return frame_batch(lines, self._full_counts)
