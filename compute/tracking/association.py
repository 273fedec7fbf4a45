"""Association of peaks with tracks, sensor by sensor, and the filter update (JPDA)."""

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.tracking.joint_events import (
    SHARED_PEAK_REACH,
    ClusterTrack,
    Marginals,
    event_marginals,
    split_clusters,
)
from compute.tracking.measurement_update import (
    Innovation,
    PdaMixture,
    leave_one_out_residuals,
    log_evidence,
    pda_update,
    reading_variance,
    update_by_readings,
)
from compute.tracking.motion_model import (
    CombinedState,
    ImmStates,
    MotionModels,
    combine_modes,
    mean_positions,
    update_mode_probabilities,
)
from compute.tracking.settings import TrackerSettings
from compute.tracking.tracks import AssociationResult

Array = NDArray[np.float64]

RELINEARISATION_STEP_MM = 0.3
"""A step as long as this is taken once more, with slopes at its end: 1e-4 px at 1.5 m."""
MAX_ITERATIONS = 3
LOST_SIGMA_FACTOR = 4.0
"""Predicted sigma of a reading, in ``max_prediction_sigma_px``, beyond which a track is lost."""
PRUNED_WEIGHT_THRESHOLD = 0.01
"""Weight of pruned joint hypotheses from which a track is ambiguous."""
SUSPECT_RESIDUAL_SIGMA = 3.0
"""A reading this far from what all others and the prediction say counts for less."""
ASSOCIATION_PROBABILITY_THRESHOLD = 0.5
"""Probability from which a peak is reported as a track's."""


def associate(
    model: MeasurementModel,
    motion: MotionModels,
    settings: TrackerSettings,
    states: ImmStates,
    bias: Array,
    peaks: Measurements,
) -> AssociationResult:
    """Associate the peaks of a frame with tracks and update their states.

    Readings that leave no choice come first, of all sensors at once; what they make of a state
    mostly decides the others. What is still contested is taken by joint hypotheses, sensor after
    sensor, the least contested first.

    Args:
        model: of the readings.
        motion: M models.
        settings: what sensors miss and invent.
        states: of T tracks, predicted to the frame.
        bias: covariance of the readings' constant errors at each track, shape (T, S, S).
        peaks: of the frame.
    """
    work = _Work(model, motion, settings, states, bias, peaks)
    work.associate_unambiguous(first=True)
    if work.contested.any():
        work.associate_unambiguous(first=False)
    if work.contested.any():
        work.associate_contested()
    work.result.in_view = work.predicted.in_view.sum(axis=1, dtype=np.int32)
    return work.result


class _Work:
    """The association in progress."""

    def __init__(
        self,
        model: MeasurementModel,
        motion: MotionModels,
        settings: TrackerSettings,
        states: ImmStates,
        bias: Array,
        peaks: Measurements,
    ) -> None:
        self.model, self.motion, self.settings = model, motion, settings
        # A copy: it is written to.
        self.result = AssociationResult.missed(states.rows(np.arange(len(states))), len(model))
        self.bias, self.peaks = bias, peaks
        self.assigned = np.zeros(peaks.position_px.shape, dtype=np.bool_)
        self.combined = combine_modes(motion, states)
        self.linearisation_mm = self.combined.mean[:, :3]
        self.predicted = model.predict(self.linearisation_mm)
        # A track that some sensor would see anywhere takes peaks that fit by chance.
        limit = (LOST_SIGMA_FACTOR * settings.max_prediction_sigma_px) ** 2
        wide = self._variance(self.combined, self.predicted.jacobian_px_per_mm) > limit
        narrow: NDArray[np.bool_] = np.logical_not((wide & self.predicted.in_view).any(axis=1))
        self.contested = np.repeat(narrow[:, None], len(model), axis=1)
        self._gain = float(np.log(settings.detection_probability / settings.clutter_density_per_px))

    def associate_unambiguous(self, *, first: bool) -> None:
        """Assign unambiguous peaks among the open tracks, and update by all of them at once."""
        moved = np.einsum(
            "tsi,ti->ts",
            self.predicted.jacobian_px_per_mm,
            self.combined.mean[:, :3] - self.linearisation_mm,
        )
        reading = self.predicted.reading_px + moved
        variance = self._variance(self.combined, self.predicted.jacobian_px_per_mm)
        choice, self.contested = self._unambiguous_peaks(reading, variance)
        used = choice >= 0
        if not used.any():
            return
        at = np.maximum(choice, 0)
        sensor = np.arange(len(self.model))
        position = np.where(used, self.peaks.position_px[sensor, at], 0.0)
        noise = self.peaks.variance_px2[sensor, at]
        # A reading that all others contradict is a false peak in a wide gate.
        for _ in range(MAX_ITERATIONS):
            innovation = Innovation.of(used, self.predicted.jacobian_px_per_mm, noise, self.bias)
            off = leave_one_out_residuals(
                self.combined, innovation, np.where(used, position - reading, 0.0)
            )
            worst = np.abs(off).argmax(axis=1)
            row = np.arange(len(used))
            bad = (np.abs(off[row, worst]) > self.settings.gate_sigma) & (used.sum(axis=1) > 2)
            if not bad.any():
                break
            used = used.copy()
            used[row[bad], worst[bad]] = False
        # One that they only doubt may be drawn by a neighbour that is not known.
        noise = np.where(
            np.abs(off) > SUSPECT_RESIDUAL_SIGMA,
            noise + self.settings.resolution_px**2 / 12.0,
            noise,
        )
        states, log, nis = self._update(
            used, position, noise, iterations=MAX_ITERATIONS if first else 1
        )
        result = self.result
        result.peaks = np.where(used, choice, result.peaks)
        result.probability = np.where(used, 1.0, result.probability)
        self.assigned[np.broadcast_to(sensor, used.shape)[used], choice[used]] = True
        before = result.states.probability
        result.log_likelihood_ratio += log_evidence(before, log) + used.sum(axis=1) * self._gain
        states.probability = before.copy()
        update_mode_probabilities(states, log)
        result.nis += (states.probability * nis).sum(axis=1)
        result.states = states
        self.combined = combine_modes(self.motion, states)

    def associate_contested(self) -> None:
        """Update the remaining tracks by joint events (JPDA), the least contested sensors first."""
        count = self.contested.sum(axis=0)
        for sensor in np.argsort(count, kind="stable"):
            if count[sensor]:
                self._take_sensor(int(sensor), np.flatnonzero(self.contested[:, sensor]))

    def _update(
        self, used: NDArray[np.bool_], position: Array, noise: Array, iterations: int
    ) -> tuple[ImmStates, Array, Array]:
        """Return the joint update; it is linearised again while steps are long."""
        states = self.result.states
        for iteration in range(iterations):
            updated = update_by_readings(
                states, self.predicted, self.linearisation_mm, used, position, noise, self.bias
            )
            position_mm = mean_positions(updated[0])
            near = np.abs(position_mm - self.linearisation_mm) < RELINEARISATION_STEP_MM
            far = np.asarray(used.any(axis=1) & ~near.all(axis=1))
            if iteration + 1 == iterations or not far.any():
                break
            self.linearisation_mm = np.where(far[:, None], position_mm, self.linearisation_mm)
            self.predicted = self.model.predict(self.linearisation_mm)
        return updated

    def _take_sensor(self, sensor: int, rows: NDArray[np.intp]) -> None:
        """Take one sensor's peaks by the joint hypotheses of the tracks ``rows``."""
        states = self.result.states.rows(rows)
        combined = combine_modes(self.motion, states)
        jacobian = self.predicted.jacobian_px_per_mm[rows, sensor]
        reading = self.predicted.reading_px[rows, sensor] + np.einsum(
            "ti,ti->t", jacobian, combined.mean[:, :3] - self.linearisation_mm[rows]
        )
        bias = self.bias[rows, sensor]
        variance = np.maximum(reading_variance(combined, jacobian, sensor, bias[:, sensor]), 0.0)
        marginals = self._event_marginals(sensor, reading, variance)
        max_count = max((len(track_marginals) for track_marginals in marginals), default=0)
        if max_count == 0:
            return
        weight, difference = np.zeros((len(rows), max_count)), np.zeros((len(rows), max_count))
        noise = np.ones((len(rows), max_count))
        for row, track_marginals in enumerate(marginals):
            for column, marginal in enumerate(track_marginals):
                weight[row, column] = marginal.probability
                difference[row, column] = marginal.difference_px
                noise[row, column] = marginal.variance_px2
        mixture = PdaMixture(weight, difference, noise)
        self.result.states.put(rows, pda_update(states, combined, mixture, sensor, jacobian, bias))
        for row, track_marginals in enumerate(marginals):
            for marginal in track_marginals:
                self._record(int(rows[row]), sensor, marginal, float(variance[row]))

    def _event_marginals(
        self, sensor: int, reading: Array, variance: Array
    ) -> list[list[Marginals]]:
        """Return the marginals of each contending track."""
        free = np.flatnonzero(self.peaks.usable[sensor] & ~self.assigned[sensor])
        columns = free, self.peaks.position_px[sensor, free], self.peaks.variance_px2[sensor, free]
        peaks = list(zip(*(column.tolist() for column in columns), strict=True))
        marginals: list[list[Marginals]] = [[] for _ in reading]
        rows = np.flatnonzero(self.contested[:, sensor])
        cluster_tracks = list(map(ClusterTrack, reading.tolist(), variance.tolist()))
        for members, cluster_peaks in split_clusters(cluster_tracks, peaks, self.settings):
            cluster_marginals, pruned_weight = event_marginals(
                [cluster_tracks[m] for m in members], cluster_peaks, self.settings
            )
            for member, track_marginals in zip(members, cluster_marginals, strict=True):
                marginals[member] = track_marginals
                pruned = pruned_weight > PRUNED_WEIGHT_THRESHOLD
                self.result.hypotheses_pruned[rows[member]] |= pruned
        return marginals

    def _record(self, track: int, sensor: int, marginal: Marginals, variance: float) -> None:
        if marginal.probability <= ASSOCIATION_PROBABILITY_THRESHOLD:
            return
        result = self.result
        result.peaks[track, sensor] = marginal.peak
        result.probability[track, sensor] = marginal.probability
        result.merged[track, sensor] = marginal.merged
        self.assigned[sensor, marginal.peak] = True
        total = variance + marginal.variance_px2
        off = marginal.difference_px**2 / total
        result.nis[track] += off
        density = -0.5 * (off + np.log(2.0 * np.pi * total))
        result.log_likelihood_ratio[track] += marginal.probability * (density + self._gain)

    def _variance(self, combined: CombinedState, jacobian: Array) -> Array:
        """Return the variance of predicted readings, constant errors included, shape (T, S)."""
        half = jacobian @ combined.covariance[:, :3, :3]
        diagonal = np.arange(len(self.model))
        variance: Array = (half * jacobian).sum(axis=2)
        variance += 2.0 * np.einsum("tsi,tis->ts", jacobian, combined.bias_cross_covariance[:, :3])
        variance += self.bias[:, diagonal, diagonal]
        return np.asarray(np.maximum(variance, 0.0))

    def _unambiguous_peaks(
        self, reading: Array, variance: Array
    ) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """Return the unambiguous peak of each track and sensor (-1: none), and the contested.

        A peak is unambiguous when it is the only one in the gate of a track, in no other's gate,
        and no neighbouring track lacks an unambiguous peak, since the two might be merged.

        Args:
            reading: predicted, shape (T, S).
            variance: of the predictions, shape (T, S).
        """
        settings, peaks = self.settings, self.peaks
        sought = self.predicted.in_view & self.contested
        sought &= variance <= settings.max_prediction_sigma_px**2
        at = np.where(sought, reading, np.inf)
        with np.errstate(invalid="ignore"):
            off = np.abs(peaks.position_px[None] - at[..., None])
            limit = settings.gate_sigma**2 * (variance[..., None] + peaks.variance_px2)
            gated = (off**2 <= limit) & peaks.usable & ~self.assigned
            alone = gated & (gated.sum(axis=0) == 1)
            unambiguous = (gated.sum(axis=2) == 1) & alone.any(axis=2)
            apart = np.abs(at[:, None] - at[None])
            sigma = np.sqrt(variance)
            reach = SHARED_PEAK_REACH * (settings.resolution_px + sigma[:, None] + sigma[None])
            near = apart <= reach
        near[np.arange(len(reading)), np.arange(len(reading))] = False
        near &= ~(unambiguous[:, None] & unambiguous[None])
        beside = near.any(axis=1)
        decided = unambiguous & ~beside
        choice = np.where(decided, gated.argmax(axis=2), -1).astype(np.int32)
        contested = sought & ~decided & (gated.any(axis=2) | beside)
        return choice, contested
