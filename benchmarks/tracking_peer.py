"""Peer of the tracking benchmark: Stone Soup JPDA on the same readings.

A competent user's Stone Soup: an extended Kalman filter of constant acceleration, one measurement
model for each sensor with its exact slope, its fastest exact JPDA (EHM2), and the marginals reduced
to one Gaussian. It starts no tracks of one-dimensional readings: each marker's is given to it with
its place and velocity.
"""

import time
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.tracking_metrics import Tracked
from benchmarks.tracking_scene import SIGMA_PX, START_SIGMA, Scene, starts_at

Array = NDArray[np.float64]

GATE = 0.99999
"""Probability of its gate: 4.4 deviations."""
_BEGIN = datetime(2000, 1, 1)  # noqa: DTZ001 - Stone Soup's own times have no zone
_PLACE = [0, 3, 6]


def stone_soup(scene: Scene, first: int, jerk_psd: float, detection: float) -> list[Tracked]:
    """Return the peer's reports of the exposures from ``first`` on."""
    from stonesoup.dataassociator.probability import JPDAwithEHM2
    from stonesoup.functions import gm_reduce_single
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.models.transition.linear import (
        CombinedLinearGaussianTransitionModel,
        ConstantAcceleration,
    )
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor
    from stonesoup.types.array import StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.types.update import GaussianStateUpdate
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    motion = CombinedLinearGaussianTransitionModel([ConstantAcceleration(jerk_psd)] * 3)
    updater = ExtendedKalmanUpdater(measurement_model=None)
    hypothesiser = PDAHypothesiser(
        ExtendedKalmanPredictor(motion),
        updater,
        clutter_spatial_density=scene.clutter_density_per_px,
        prob_detect=detection,
        prob_gate=GATE,
    )
    associator = JPDAwithEHM2(hypothesiser)
    models = measurement_models(scene)
    covariance = np.diag(np.tile(START_SIGMA, 3)) ** 2
    tracks = []
    given = starts_at(scene, first)
    for position, velocity in zip(given.position_mm, given.velocity_mm_s, strict=True):
        mean = np.stack([position, velocity, np.zeros(3)], axis=1).ravel()
        begin = _BEGIN + timedelta(seconds=float(scene.times_s[first]))
        tracks.append(Track([GaussianState(mean[:, None], covariance, timestamp=begin)]))
    found = []
    for exposure in range(first, len(scene.times_s)):
        now = _BEGIN + timedelta(seconds=float(scene.times_s[exposure]))
        begin_s = time.thread_time()
        for model, line in zip(models, scene.peaks_px[exposure], strict=True):
            detections = {
                Detection(np.array([[value]]), timestamp=now, measurement_model=model)
                for value in line[np.isfinite(line)]
            }
            for track, options in associator.associate(set(tracks), detections, now).items():
                means, covariances, weights = [], [], []
                for option in options:
                    state = updater.update(option) if option else option.prediction
                    means.append(state.state_vector)
                    covariances.append(state.covar)
                    weights.append(option.probability)
                mean, spread = gm_reduce_single(
                    StateVectors(means), np.stack(covariances, axis=2), np.asarray(weights)
                )
                track.append(GaussianStateUpdate(mean, spread, options, now))
        seconds = time.thread_time() - begin_s
        states = [track[-1] for track in tracks]
        for track in tracks:
            # Its history is not asked for; kept, it would grow.
            del track.states[:-1]
        found.append(
            Tracked(
                np.arange(len(tracks)),
                np.stack([np.asarray(s.state_vector, dtype=float)[_PLACE, 0] for s in states]),
                np.stack([np.asarray(s.covar)[np.ix_(_PLACE, _PLACE)] for s in states]),
                seconds,
            )
        )
    return found


def measurement_models(scene: Scene) -> list[Any]:
    """Return a Stone Soup measurement model for each sensor, with an exact Jacobian."""
    from stonesoup.base import Property
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
    from stonesoup.types.array import StateVector

    class LineSensor(NonLinearGaussianMeasurement):  # type: ignore[misc]
        """One sensor's reading of a place."""

        camera: Any = Property(doc="Rows m1 and m2 of the sensor's matrix")

        @property
        def ndim_meas(self) -> int:
            return 1

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            position = np.asarray(state.state_vector, dtype=float)[_PLACE]
            along, depth = self.camera[:, :3] @ position + self.camera[:, 3:]
            reading = along / depth
            if isinstance(noise, bool):
                noise = self.rvs() if noise else 0.0
            return StateVector([float(reading[0])]) + noise

        def jacobian(self, state: Any, **_: Any) -> Array:
            position = np.asarray(state.state_vector, dtype=float)[_PLACE, 0]
            along, depth = self.camera[:, :3] @ position + self.camera[:, 3]
            slope = np.zeros((1, 9))
            slope[0, _PLACE] = (self.camera[0, :3] - along / depth * self.camera[1, :3]) / depth
            return slope

    return [
        LineSensor(
            ndim_state=9,
            mapping=tuple(_PLACE),
            noise_covar=np.array([[SIGMA_PX**2]]),
            camera=matrix,
        )
        for matrix in scene.cameras.matrices
    ]
