"""Renders the frames of a profile's device: scene, light, traced optics, detector; in batches."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector_array import DetectorArray
from compute.optics.footprints import FootprintOptics, line_electrons
from compute.optics.profiles.build import light_source, profile_optics
from compute.optics.profiles.profile import DeviceProfile
from hardware.simulated.batch import Batch, Timing, batch_rng, batch_sequence, finished_batch
from hardware.simulated.profile_settings import ProfileSettings


class ProfileRenderer:
    """The exposures of a profile's device by their number; markers face every sensor.

    The optics are traced when the first batch is asked for.

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
        self._lenses_mm = np.array([sensor.position_mm for sensor in profile.sensors])
        detector = profile.detector.detector(profile.rates.exposure_s)
        self._full_scale = detector.full_scale
        self._detector = DetectorArray(
            detector,
            len(profile.sensors),
            profile.pixels.count,
            pattern_seed=settings.pattern_seed,
        )

    @cached_property
    def _optics(self) -> FootprintOptics:
        return profile_optics(self._profile, self._settings.optics)

    def signal_electrons(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the mean electrons of the markers in N exposures, shape (N, sensors, pixels)."""
        points = self._timing.lit(self._scene.points(self._timing.time_s(sequence)), sequence)
        flat = points.reshape(-1, 3)
        photons = self._source.photons_per_sr(
            flat, None, self._lenses_mm, self._profile.rates.exposure_s
        )
        return line_electrons(
            self._optics.footprints(flat),
            photons * self._profile.detector.quantum_efficiency,
            points.shape[1],
            self._profile.pixels.count,
        )

    def batch(self, number: int) -> Batch:
        """Render exposures ``BATCH * number`` to ``BATCH * (number + 1) - 1``."""
        signal = self.signal_electrons(batch_sequence(number))
        lines = self._detector.expose(signal, batch_rng(self._settings.seed, number))
        return finished_batch(lines, self._full_scale)
