"""Acquisition of a strobed tool from exposures of its markers in turn.

The tool moves while its markers are lit in turn, so its latest readings fit no single pose. They
give a rough one, with standard deviations that grow with their age. A filter with a broad prior
then runs over the exposures repeatedly, until the state converges.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import exp_so3
from compute.measurement.measurement_model import MeasurementModel
from compute.pose.estimation.observability import missing_readings
from compute.pose.estimation.pose_equations import PoseCandidates, PoseEquations
from compute.pose.estimation.pose_fit import solutions
from compute.pose.estimation.pose_initialisation import initial_poses_from_readings, rough_position
from compute.pose.filtering.association import common_jacobian, robust_update
from compute.pose.filtering.pose_filter import (
    STATES,
    FilterUpdate,
    PoseState,
    initial_state,
    predict,
    predict_measurement,
    update,
)
from compute.pose.rigid_body import CentredMarkers
from compute.pose.settings import ToolTrackerSettings
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

PASSES: Final = 4
MAX_CANDIDATES: Final = 4
INITIAL_ROTATION_SIGMA_RAD: Final = 0.2
INITIAL_POSITION_SIGMA_FRACTION: Final = 0.5
"""Standard deviation of an initial position over the markers' radius, without motion."""
MIN_CONSISTENT_FRACTION: Final = 0.8
"""Least fraction of the readings that must fit: with fewer, the rest may fit by chance."""
MIN_SENSORS: Final = 3
"""Number of sensors that find a moving tool in any layout; two find it in some layouts only."""
MAX_DELAY_FRACTION: Final = 0.1
"""Largest delay by the pauses, as a fraction of the time of unsuccessful searches."""
MAX_PAUSE_NS: Final = 250_000_000
"""Longest pause between two searches."""
SAME_POSE_FRACTION: Final = 0.02
"""States whose markers are closer than this fraction of the radius are the same solution: filter
passes converge to it only approximately."""


@dataclass(frozen=True, eq=False)
class MarkerExposure:
    """Readings of one lit marker.

    Args:
        time_ns: middle of the exposure [ns].
        marker: index of the marker in its tool.
        readings_px: shape (S,) [px]; NaN where a sensor saw nothing, or more than one peak.
        sigma_px: shape (S,) [px].
    """

    time_ns: int
    marker: int
    readings_px: Array
    sigma_px: Array

    @property
    def any_reading(self) -> bool:
        """Whether any sensor saw the marker."""
        return bool(np.isfinite(self.readings_px).any())


class AcquisitionBackoff:
    """Limits how often one lost strobed tool is searched for.

    A search costs as much as tracking twenty exposures or more. A tool that is seen well is found
    by the first, or soon; one with few and often false readings by the thirtieth; one whose
    readings never fit, because of a wrong calibration or another tool's markers, is searched for
    at growing intervals. The pauses grow in proportion to the time of unsuccessful searches, up to
    MAX_PAUSE_NS, so that waiting delays the acquisition by no more than that fraction. They restart
    when more readings are available than in any search before.
    """

    def __init__(self) -> None:
        """Start without any search."""
        self.reset()

    def reset(self) -> None:
        """Restart: the tool was found, or its readings changed."""
        self._first_ns: int | None = None  # of the searches in vain
        self._failed_ns = 0
        self._left = 0
        self._max_readings = -1

    @property
    def is_waiting(self) -> bool:
        """Whether a search failed since the last restart."""
        return self._first_ns is not None

    def count_exposure(self) -> None:
        """Count an exposure of the tool's markers."""
        self._left -= 1

    def due(self, time_ns: int, readings: int) -> bool:
        """Return whether to search now.

        Args:
            time_ns: time of the exposure [ns].
            readings: number of readings; more than in any search before are worth one.
        """
        if self._first_ns is None or readings > self._max_readings:
            return True
        pause_ns = time_ns - self._failed_ns
        enough_ns = MAX_DELAY_FRACTION * (self._failed_ns - self._first_ns)
        return pause_ns >= MAX_PAUSE_NS or (self._left <= 0 and pause_ns >= enough_ns)

    def record_failure(self, time_ns: int, readings: int, exposures: int) -> None:
        """Record an unsuccessful search.

        Args:
            time_ns: time of the latest exposure [ns].
            readings: number of readings that the search had.
            exposures: smallest number of exposures until the next search.
        """
        if self._first_ns is None or readings > self._max_readings:
            self._first_ns, self._max_readings = time_ns, readings
        self._failed_ns, self._left = time_ns, exposures


@dataclass(frozen=True, eq=False)
class StrobedAcquisition:
    """A tool found, or the reason why it was not.

    Args:
        state: state at the last exposure; None: not found.
        reason: why it was not found; None if it was.
        inconsistent: whether there were enough readings and they did not fit.
        nis: normalised innovation squared of all readings.
        readings: number of readings.
        searched: whether all rotations were searched, which is slow.
    """

    state: PoseState | None
    reason: str | None
    inconsistent: bool = False
    nis: float = 0.0
    readings: int = 0
    searched: bool = False


def acquire_strobed(
    model: MeasurementModel,
    centred: CentredMarkers,
    exposures: Sequence[MarkerExposure],
    common_errors: int,
    settings: ToolTrackerSettings,
) -> StrobedAcquisition:
    """Find a tool from the latest exposures of its markers, oldest first.

    Args:
        model: the cameras.
        centred: the tool's markers.
        exposures: exposures of these markers only.
        common_errors: number of common errors that the state carries.
        settings: settings of fits and motion.

    Returns:
        The state at the last exposure, or the reason why there is none.
    """
    count = sum(int(np.isfinite(one.readings_px).sum()) for one in exposures)
    if count < STATES + settings.fit.min_redundancy:
        return StrobedAcquisition(
            None,
            f"{count} readings so far; pose and velocity take {STATES} and "
            f"{settings.fit.min_redundancy} more to check them",
        )
    readings, sigma, age_s = _latest_per_marker(exposures, len(centred.markers_mm), len(model))
    reason = missing_readings(centred, np.isfinite(readings), settings.fit)
    if reason is not None:
        return StrobedAcquisition(None, reason)
    inflated_sigma = _motion_inflated_sigma(
        model, readings, sigma, age_s, settings.motion.velocity_sigma_mm_s
    )
    if inflated_sigma is None:
        return StrobedAcquisition(None, "the readings' planes tell no place")
    starts = initial_poses_from_readings(model, centred, readings, inflated_sigma)
    if not len(starts[0]):
        reason = _too_few_sensors(exposures) or "the readings tell no turn"
        return StrobedAcquisition(None, reason, searched=True)
    equations = PoseEquations(model, centred, readings, inflated_sigma)
    found = _best_candidate(
        model, centred, exposures, solutions(equations, *starts), common_errors, settings
    )
    return replace(found, searched=True)


def _best_candidate(
    model: MeasurementModel,
    centred: CentredMarkers,
    exposures: Sequence[MarkerExposure],
    found: PoseCandidates,
    common_errors: int,
    settings: ToolTrackerSettings,
) -> StrobedAcquisition:
    """Return the best state that the filter reaches from the rough poses, if it is unambiguous."""
    accepted: list[StrobedAcquisition] = []
    for candidate in range(min(MAX_CANDIDATES, len(found.chi2))):
        one = _iterate_filter(
            model,
            centred,
            exposures,
            found.rotation[candidate],
            found.centroid_mm[candidate],
            common_errors,
            settings,
        )
        if one is not None:
            accepted.append(one)
    if not accepted:
        reason = _too_few_sensors(exposures)
        if reason is not None:
            return StrobedAcquisition(None, reason)
        count = sum(int(np.isfinite(one.readings_px).sum()) for one in exposures)
        return StrobedAcquisition(
            None,
            f"{count} readings of {len(exposures)} exposures do not fit the tool",
            inconsistent=True,
        )
    accepted.sort(key=lambda one: one.nis)
    best = accepted[0]
    rivals = [
        one
        for one in accepted[1:]
        if one.nis <= best.nis + settings.fit.ambiguity_chi2_margin and _differ(centred, best, one)
    ]
    if rivals:
        return StrobedAcquisition(
            None,
            f"the readings fit the tool in {1 + len(rivals)} ways: chi2 is {best.nis:.4g} and "
            f"{rivals[0].nis:.4g}",
            inconsistent=True,
        )
    return best


def _too_few_sensors(exposures: Sequence[MarkerExposure]) -> str | None:
    """Return a reason where no more than two sensors saw the tool.

    A moving tool that only two sensors see is often not found although its readings are right: its
    motion between the exposures is large compared with what they determine.
    """
    readings = np.array([one.readings_px for one in exposures])
    seen: NDArray[np.bool_] = np.isfinite(readings).any(axis=0)
    which = np.flatnonzero(seen) + 1
    if len(which) > MIN_SENSORS - 1:
        return None
    names = " and ".join(str(one) for one in which)
    return (
        f"only sensor{'' if len(which) == 1 else 's'} {names} of {len(seen)} saw it; its readings "
        f"do not tell where it is, {MIN_SENSORS} sensors are needed to find it"
    )


def _latest_per_marker(
    exposures: Sequence[MarkerExposure], markers: int, sensors: int
) -> tuple[Array, Array, Array]:
    """Return the latest readings and sigmas of each marker (M, S), and their age (M, 1) [s]."""
    readings, sigma = np.full((markers, sensors), np.nan), np.full((markers, sensors), np.nan)
    age = np.zeros((markers, 1))
    for one in exposures:
        readings[one.marker], sigma[one.marker] = one.readings_px, one.sigma_px
        age[one.marker] = 1e-9 * (exposures[-1].time_ns - one.time_ns)
    return readings, sigma, age


def _motion_inflated_sigma(
    model: MeasurementModel,
    readings_px: Array,
    sigma_px: Array,
    age_s: Array,
    velocity_sigma_mm_s: float,
) -> Array | None:
    """Return standard deviations that include the possible motion since each reading, (M, S)."""
    place = rough_position(model, readings_px, sigma_px)
    if place is None:
        return None
    slope = np.linalg.norm(model.linearise(place[None])[1][0], axis=1)
    slope = np.where(np.isfinite(slope), slope, 0.0)
    found: Array = np.hypot(sigma_px, velocity_sigma_mm_s * age_s * slope)
    return found


def _iterate_filter(
    model: MeasurementModel,
    centred: CentredMarkers,
    exposures: Sequence[MarkerExposure],
    rotation: Array,
    centroid_mm: Array,
    common_errors: int,
    settings: ToolTrackerSettings,
) -> StrobedAcquisition | None:
    """Filter the exposures repeatedly from an initial pose; None where they do not fit."""
    motion = settings.motion
    span_s = 1e-9 * (exposures[-1].time_ns - exposures[0].time_ns)
    place_sd = (
        INITIAL_POSITION_SIGMA_FRACTION * centred.radius_mm + motion.velocity_sigma_mm_s * span_s
    )
    broad = np.diag([INITIAL_ROTATION_SIGMA_RAD**2] * 3 + [place_sd**2] * 3)
    begin, end = exposures[0].time_ns, exposures[-1].time_ns
    state = initial_state(begin, rotation, centroid_mm, broad, motion, common_errors)
    offered = sum(int(np.isfinite(one.readings_px).sum()) for one in exposures)
    probability = settings.fit.false_rejection_probability
    for iteration in range(PASSES):
        last = iteration == PASSES - 1
        # A pass beyond these limits cannot be accepted any more: it ends early.
        max_nis = chi2_limit(offered - 6, probability) if last else np.inf
        max_excluded = (1.0 - MIN_CONSISTENT_FRACTION) * offered if last else np.inf
        filtered = _filter_pass(
            model,
            centred,
            exposures,
            state,
            settings,
            robust=iteration > 1,
            max_nis=max_nis,
            max_excluded=max_excluded,
        )
        found = None if filtered is None else filtered.state
        if filtered is None or found is None:
            return None
        if last:
            limit = chi2_limit(filtered.readings - 6, probability)
            enough = filtered.readings >= STATES + settings.fit.min_redundancy
            enough &= filtered.readings >= MIN_CONSISTENT_FRACTION * offered
            return filtered if enough and filtered.nis <= limit else None
        # The next pass starts from this state; the broad prior stays.
        state = replace(
            state,
            rotation=exp_so3(-1e-9 * (end - begin) * found.angular_velocity_rad_s) @ found.rotation,
            centroid_mm=found.centroid_mm - 1e-9 * (end - begin) * found.velocity_mm_s,
            velocity_mm_s=found.velocity_mm_s,
            angular_velocity_rad_s=found.angular_velocity_rad_s,
        )
    return None


def _filter_pass(
    model: MeasurementModel,
    centred: CentredMarkers,
    exposures: Sequence[MarkerExposure],
    state: PoseState,
    settings: ToolTrackerSettings,
    *,
    robust: bool,
    max_nis: float,
    max_excluded: float,
) -> StrobedAcquisition | None:
    """Filter the exposures once; None where an exposure, or all together, do not fit."""
    nis, count, excluded = 0.0, 0, 0
    taken: FilterUpdate | None
    for one in exposures:
        state = predict(state, one.time_ns, settings.motion)
        seen = np.flatnonzero(np.isfinite(one.readings_px))
        if len(seen) == 0:
            continue
        lit = np.array([one.marker])
        arms = centred.markers_mm[lit] @ state.rotation.T
        expected = model.predict(arms + state.centroid_mm, with_common_errors=True)
        if not np.isfinite(expected.reading_px[0, seen]).all():
            return None
        common = common_jacobian(expected, lit, state.common.shape[1])
        prediction = predict_measurement(state, arms, expected, common)
        if len(seen) < len(model):
            prediction = prediction.of(seen)
        residual = one.readings_px[seen] - prediction.value_px
        if robust:
            taken = robust_update(
                state, prediction, residual, one.sigma_px[seen], settings.gate_probability
            )
            if taken is None:
                return None
        else:
            taken = update(state, prediction, residual, one.sigma_px[seen])
        state = taken.state
        nis += taken.nis
        count += len(taken.kept)
        excluded += len(seen) - len(taken.kept)
        if nis > max_nis or excluded > max_excluded + 0.5:
            return None
    return StrobedAcquisition(state, None, False, nis, count)


def _differ(centred: CentredMarkers, first: StrobedAcquisition, second: StrobedAcquisition) -> bool:
    """Return whether two states have a marker at different places."""
    assert first.state is not None
    assert second.state is not None
    distance = np.abs(
        first.state.marker_positions(centred) - second.state.marker_positions(centred)
    ).max()
    return bool(distance > SAME_POSE_FRACTION * centred.radius_mm)
