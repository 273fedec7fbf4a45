"""Renders simulated frames in batches: scene, ideal optics, stripe images, detector."""

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector import Detector
from compute.optics.ideal_optics import IdealOptics
from compute.optics.pixel_solid_angles import stripe_images
from hardware.simulated.frame_batch import Renderer
from hardware.simulated.settings import SimulationSettings
from hardware.simulated.simulated_rig import PIXELS, WORKING_CENTRE_MM, simulated_rig


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
            ambient_electrons=settings.ambient_electrons,
        )
        super().__init__(detector, detector.full_scale, settings.seed)

    def signal_electrons(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the mean electrons of the markers in N exposures, shape (N, sensors, pixels)."""
        timing = self._settings.timing
        points = timing.lit(self._settings.scene.points(timing.time_s(sequence)), sequence)
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
