"""Association of peaks with the markers of tracked tools.

The markers of a tool move together, so its peaks are associated jointly: first the unambiguous
ones, which update the tool's pose; then the others, with the smaller gates of the updated pose. A
peak that still has two markers, or a marker that still has two peaks, is not used: merged stripes
and false peaks are never resolved by a guess.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel, PredictedMeasurements
from compute.measurement.measurements import Measurements
from compute.pose.filtering.imm import ImmState
from compute.pose.filtering.pose_filter import (
    FilterUpdate,
    MeasurementPrediction,
    PoseState,
    predict_measurement,
    update,
)
from compute.pose.filtering.second_order import needs_second_order, second_order_prediction
from compute.pose.rigid_body import CentredMarkers
from compute.reconstruction.triangulation import chi2_limit

if TYPE_CHECKING:
    from compute.pose.filtering.native.strobed_step import Step

Array = NDArray[np.float64]

ASSOCIATION_ROUNDS: Final = 3
RIVAL_VARIANCE_RATIO: Final = 16.0
"""A marker does not compete for a peak with another whose variance is smaller by this factor."""
NEAR_MISS_PX: Final = 8.0
"""An unassociated peak this close to a predicted marker is likely the marker's; farther away it is
more likely a false peak beside a hidden marker."""
MAX_EXCLUDED_NIS: Final = 25.0
"""Largest normalised square of an excluded reading: a single one may have any error."""


def without_peaks(measurements: Measurements, taken: Iterable[NDArray[np.intp]]) -> Measurements:
    """Return the measurements without the peaks that tools have taken; the indices stay.

    Args:
        measurements: the frame's peaks, shape (S, K).
        taken: index of the peak that each marker of a tool took on each sensor, -1: none, shapes
            (m, S).
    """
    free = measurements.usable.copy()
    for peaks in taken:
        row, sensor = np.nonzero(peaks >= 0)
        free[sensor, peaks[row, sensor]] = False
    return measurements.only(free)


@dataclass(eq=False)
class ToolObservation:
    """A tool in one frame: prediction, associated peaks, and the updated state.

    Args:
        centred: the tool's markers.
        lit: indices of the markers that this exposure lights, shape (m,).
        state: predicted state at the exposure; updated by association. With several motion
            models, that of the widest one.
        imm: predicted states of all motion models, updated likewise; None: there is one model.
        step: result of the kernel, for the only tool that the exposure lights.
        peaks: index of each marker's peak on each sensor, -1: none, shape (m, S).
        merged: readings that are not used because their stripes may be merged, shape (m, S).
        nis: normalised innovation squared of the associated readings.
        readings: number of associated readings.
        whitened: innovations and their Jacobian with respect to the common errors, of a tool with
            several motion models.
        misfit: readings within the gates did not fit the tool.
    """

    centred: CentredMarkers
    lit: NDArray[np.intp]
    state: PoseState
    imm: ImmState | None = None
    step: "Step | None" = None
    peaks: NDArray[np.intp] = field(init=False)
    merged: NDArray[np.bool_] = field(init=False)
    nis: float = 0.0
    readings: int = 0
    whitened: list[Array] = field(default_factory=list)
    misfit: bool = False

    _excluded_nis: Array | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._predicted = self.state, self.imm

    def accept_step(self) -> None:
        """Accept the association and the update of the kernel."""
        step = self.step
        assert step is not None
        assert step.imm is not None
        self.peaks, self.readings, self.nis = step.peaks, step.readings, step.nis
        self.misfit, self._excluded_nis = step.misfit, step.excluded
        if step.readings:
            self.imm, self.state = step.imm, step.imm.widest_state
            self.whitened.append(step.whitened)

    def roll_back(self) -> None:
        """Restore the prediction: the associated readings do not fit."""
        self.state, self.imm = self._predicted
        self.nis, self.readings, self.misfit = 0.0, 0, True
        self.whitened.clear()
        self.peaks = np.full_like(self.peaks, -1)

    def excluded_nis(
        self, model: MeasurementModel, free: Measurements, gate_probability: float
    ) -> Array:
        """Return the normalised squares of the excluded readings, shape (m, S).

        A reading is excluded where a marker has no peak although an unassociated one lies close to
        its prediction. The squares are at most MAX_EXCLUDED_NIS, and 0 elsewhere.

        Args:
            model: the cameras.
            free: the peaks that no tool has taken.
            gate_probability: probability that a correct reading is outside the gate.
        """
        if self._excluded_nis is not None:
            return self._excluded_nis
        off = np.zeros(self.peaks.shape)
        unassociated = (self.peaks < 0) & ~self.merged & free.usable.any(axis=1)
        if not unassociated.any():
            return off
        (prediction,) = _predict_observed(
            model, [self], float(np.sqrt(free.variance_px2[free.usable].min()))
        )
        value = prediction.value_px.reshape(*off.shape, 1)
        variance = prediction.covariance.diagonal().reshape(*off.shape, 1) + free.variance_px2
        distance = np.where(free.usable, np.abs(free.position_px - value), np.inf)
        square = np.where(distance <= NEAR_MISS_PX, distance**2 / variance, np.inf).min(axis=2)
        # A peak within the gate fits; it was only ambiguous.
        near = unassociated & (square < np.inf) & (square > chi2_limit(1, gate_probability))
        off[near] = np.minimum(square[near], MAX_EXCLUDED_NIS)
        return off

    def count_contradictions(self, free: NDArray[np.intp]) -> int:
        """Return the number of unassociated peaks that could be markers without a peak.

        A hidden marker leaves no peak. A tool with a wrong pose gets some readings by chance, or on
        the sensors that cannot distinguish it, and its true peaks on the others stay unassociated.

        Args:
            free: number of unassociated peaks of each sensor, shape (S,).
        """
        missed = ((self.peaks < 0) & ~self.merged).sum(axis=0)
        return int(np.minimum(missed, free).sum())

    def readings_px(self, measurements: Measurements) -> tuple[Array, Array]:
        """Return the associated readings and sigmas of all markers, shapes (M, S)."""
        markers = len(self.centred.markers_mm)
        return marker_readings(markers, self.lit, self.peaks, measurements)


def marker_readings(
    markers: int, lit: NDArray[np.intp], peaks: NDArray[np.intp], measurements: Measurements
) -> tuple[Array, Array]:
    """Return readings and sigmas of all markers of a tool, shapes (M, S) [px]; NaN: none.

    Args:
        markers: number M of its markers.
        lit: indices of the markers that the exposure lit, shape (m,).
        peaks: index of each one's peak on each sensor, -1: none, shape (m, S).
        measurements: the frame's peaks.
    """
    readings = np.full((markers, peaks.shape[1]), np.nan)
    sigma = readings.copy()
    row, sensor = np.nonzero(peaks >= 0)
    peak = peaks[row, sensor]
    readings[lit[row], sensor] = measurements.position_px[sensor, peak]
    sigma[lit[row], sensor] = np.sqrt(measurements.variance_px2[sensor, peak])
    return readings, sigma


def associate(
    model: MeasurementModel,
    observations: Collection[ToolObservation],
    measurements: Measurements,
    gate_probability: float,
    resolution_px: float,
) -> None:
    """Associate the peaks of a frame with several tools and update their states in place.

    Args:
        model: the cameras.
        observations: the predicted tools; they are updated.
        measurements: the frame's peaks, shape (S, K).
        gate_probability: probability that a correct reading is outside the gate.
        resolution_px: stripes closer than this may be one peak [px].
    """
    active = [observation for observation in observations if len(observation.lit)]
    alone = active[0] if len(active) == 1 else None
    ready = alone is not None and alone.step is not None and alone.step.imm is not None
    for observation in observations:
        shape = (len(observation.lit), len(model))
        observation.merged = np.zeros(shape, dtype=np.bool_)
        if ready and observation is alone:
            observation.accept_step()
        else:
            observation.peaks = np.full(shape, -1, dtype=np.intp)
    if ready or not np.count_nonzero(measurements.usable):
        return
    free = measurements.usable.copy()
    gate = chi2_limit(1, gate_probability)
    sigma = float(np.sqrt(measurements.variance_px2[free].min()))
    if len(active) == 1 and len(active[0].lit) == 1 and free.shape[1] == 1:
        # A strobed exposure with one peak on each sensor is unambiguous.
        (one,) = _predict_observed(model, active, sigma)
        row, sensor, peak = np.nonzero(
            _gated_variances(active[0], one, measurements, free, gate) < np.inf
        )
        if len(row):
            _update_from_peaks(active[0], one, measurements, row, sensor, peak, gate_probability)
        return
    for _ in range(ASSOCIATION_ROUNDS if active else 0):
        prediction = _predict_observed(model, active, sigma)
        offers = [
            _gated_variances(*pair, measurements, free, gate)
            for pair in zip(active, prediction, strict=True)
        ]
        if len(offers) > 1 or len(offers[0]) > 1:
            _withdraw_merged(active, prediction, offers, measurements, resolution_px)
        # A tool with a large covariance has wide gates: it does not keep peaks from a tool with
        # narrow ones.
        every = offers[0] if len(offers) == 1 else np.concatenate(offers)
        strong = RIVAL_VARIANCE_RATIO * every.min(axis=0)
        gated = (every <= strong) & (every < np.inf)
        claims = gated.sum(axis=0)
        any_updated, any_open = False, bool((claims > 1).any())
        for observation, one, offer in zip(active, prediction, offers, strict=True):
            gated_by_tool = offer < np.inf
            number = gated_by_tool.sum(axis=2, keepdims=True)
            single = gated_by_tool & (offer <= strong) & (claims == 1) & (number == 1)
            row, sensor, peak = np.nonzero(single)
            if len(row) and not observation.misfit:
                any_updated |= _update_from_peaks(
                    observation, one, measurements, row, sensor, peak, gate_probability
                )
                row_updated, sensor_updated = np.nonzero(observation.peaks >= 0)
                free[sensor_updated, observation.peaks[row_updated, sensor_updated]] = False
            any_open |= bool((number > 1).any())
        if not any_updated or not any_open:
            return


def _predict_observed(
    model: MeasurementModel, observations: list[ToolObservation], sigma_px: float
) -> list[MeasurementPrediction]:
    """Return the predicted readings of the lit markers of all tools, in one call of the cameras."""
    arms = [one.centred.markers_mm[one.lit] @ one.state.rotation.T for one in observations]
    marker_positions = np.concatenate(
        [arm + one.state.centroid_mm for arm, one in zip(arms, observations, strict=True)]
    )
    predicted = model.predict(marker_positions, with_common_errors=True)
    focal = float(model.cameras.principal_distance_px.min())
    predictions = []
    first = 0
    for arm, observation in zip(arms, observations, strict=True):
        centred, lit, state = observation.centred, observation.lit, observation.state
        part = predicted.part(first, first + len(arm))
        first += len(arm)
        common = common_jacobian(part, lit, state.common.shape[1])
        prediction = predict_measurement(state, arm, part, common)
        if needs_second_order(state, centred, prediction, focal, sigma_px):
            prediction = second_order_prediction(model, centred, lit, state, prediction)
        predictions.append(prediction)
    return predictions


def common_jacobian(
    expected: PredictedMeasurements, lit: NDArray[np.intp], common_errors: int
) -> Array:
    """Return the Jacobian of readings with respect to all common errors, shape (m, S, errors).

    First come the errors of the calibration, then, with a correction table, one for each of the
    tool's markers and sensors: the table's error at the position, the same in every frame.

    Args:
        expected: predicted readings of m markers by S sensors.
        lit: indices of the markers in the tool, shape (m,).
        common_errors: number of common errors of the tool's filter.
    """
    calibration_jacobian = expected.common_jacobian_px
    markers, sensors, count = calibration_jacobian.shape
    if common_errors == count:
        return calibration_jacobian
    common = np.zeros((markers, sensors, common_errors))
    common[..., :count] = calibration_jacobian
    row, sensor = np.meshgrid(np.arange(markers), np.arange(sensors), indexing="ij")
    common[row, sensor, count + lit[row] * sensors + sensor] = np.sqrt(expected.table_variance_px2)
    return common


def _gated_variances(
    observation: ToolObservation,
    prediction: MeasurementPrediction,
    measurements: Measurements,
    free: NDArray[np.bool_],
    gate: float,
) -> Array:
    """Return the variance of each pair of marker and peak, shape (m, S, K) [px^2].

    Infinite where the peak is taken or outside the gate, and for markers that have a peak.
    """
    shape = observation.peaks.shape
    value = prediction.value_px.reshape(shape)[..., None]
    variance = (
        prediction.covariance.diagonal().reshape(shape)[..., None] + measurements.variance_px2
    )
    with np.errstate(invalid="ignore"):
        offer = (measurements.position_px - value) ** 2 <= gate * variance
    offer &= free & (observation.peaks < 0)[..., None]
    return np.where(offer, variance, np.inf)


def _withdraw_merged(
    observations: list[ToolObservation],
    prediction: list[MeasurementPrediction],
    offers: list[Array],
    measurements: Measurements,
    resolution_px: float,
) -> None:
    """Exclude markers whose stripes may be merged with another marker's.

    Two stripes a tenth of a pixel apart are one peak, which nothing marks as such: its error is ten
    times its sigma, and still within the gates of both. Where more markers than peaks are predicted
    within the width of a stripe, none of them is used.
    """
    sensors = len(measurements.found_px)
    value = np.concatenate([one.value_px.reshape(-1, sensors) for one in prediction])
    markers = (np.abs(value[:, None] - value[None]) <= resolution_px).sum(axis=1)
    crowded = markers > 1
    if not crowded.any():
        return
    peaks = (np.abs(measurements.found_px - value[..., None]) <= resolution_px).sum(axis=2)
    merged = crowded & (markers > peaks)
    first = 0
    for observation, offer in zip(observations, offers, strict=True):
        observation.merged = merged[first : first + len(offer)]
        offer[observation.merged] = np.inf
        first += len(offer)


def _update_from_peaks(
    observation: ToolObservation,
    prediction: MeasurementPrediction,
    measurements: Measurements,
    row: NDArray[np.intp],
    sensor: NDArray[np.intp],
    peak: NDArray[np.intp],
    probability: float,
) -> bool:
    """Update a tool by its unambiguous peaks; return whether they fit."""
    some = prediction.of(row * observation.peaks.shape[1] + sensor)
    residual = measurements.position_px[sensor, peak] - some.value_px
    sigma = np.sqrt(measurements.variance_px2[sensor, peak])
    if observation.imm is None:
        filter_update = robust_update(observation.state, some, residual, sigma, probability)
    else:
        filter_update = _update_imm(observation, some, residual, sigma, probability)
    if filter_update is None:
        observation.misfit = True
        return False
    observation.state = filter_update.state
    observation.nis += filter_update.nis
    if filter_update.whitened is not None:
        observation.whitened.append(filter_update.whitened)
    observation.readings += len(filter_update.accepted)
    observation.peaks[row[filter_update.accepted], sensor[filter_update.accepted]] = peak[
        filter_update.accepted
    ]
    return True


def _update_imm(
    observation: ToolObservation,
    prediction: MeasurementPrediction,
    residual_px: Array,
    sigma_px: Array,
    probability: float,
) -> FilterUpdate | None:
    """Update all motion models by n readings, those that fit the widest one."""
    assert observation.imm is not None
    imm_update = observation.imm.update(prediction, residual_px, sigma_px)
    accepted = np.arange(len(residual_px))
    if not imm_update.widest_nis <= chi2_limit(len(accepted), probability):
        robust = robust_update(observation.state, prediction, residual_px, sigma_px, probability)
        if robust is None:
            return None
        accepted = robust.accepted
        imm_update = observation.imm.update(
            prediction.of(accepted), residual_px[accepted], sigma_px[accepted]
        )
    observation.imm = imm_update.imm
    return FilterUpdate(imm_update.imm.widest_state, imm_update.nis, accepted, imm_update.whitened)


def robust_update(
    state: PoseState,
    prediction: MeasurementPrediction,
    residual_px: Array,
    sigma_px: Array,
    probability: float,
) -> FilterUpdate | None:
    """Update a state by n readings, without those that contradict the others.

    The reading with the largest ``(S^-1 r)^2 / (S^-1)_ii`` is excluded until the rest fit.

    Args:
        state: the predicted state.
        prediction: the predicted readings.
        residual_px: readings less predictions, shape (n,) [px].
        sigma_px: standard deviations of the readings, shape (n,) [px].
        probability: probability that correct readings are rejected.

    Returns:
        The update; None where more than a quarter of the readings (one of three) would have to be
        excluded.
    """
    filter_update = update(state, prediction, residual_px, sigma_px)
    if filter_update.nis <= chi2_limit(len(residual_px), probability):
        return filter_update
    index = np.arange(len(residual_px))
    for _ in range((len(index) + 1) // 4):
        innovation_covariance = prediction.covariance[np.ix_(index, index)] + np.diag(
            sigma_px[index] ** 2
        )
        inverse = np.linalg.inv(innovation_covariance)
        blame = (inverse @ residual_px[index]) ** 2 / inverse.diagonal()
        index = np.delete(index, np.argmax(blame))
        filter_update = update(state, prediction.of(index), residual_px[index], sigma_px[index])
        if filter_update.nis <= chi2_limit(len(index), probability):
            return replace(filter_update, accepted=index)
    return None
