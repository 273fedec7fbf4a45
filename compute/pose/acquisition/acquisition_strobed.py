"""Acquisition of a strobed tool from exposures of one marker at a time.

The tool moves while its markers are lit in turn, so its latest readings fit no single pose. They
give a rough one, with standard deviations that grow with their age. A filter with a broad prior
then runs over the exposures repeatedly, until the state converges.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

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
from compute.transform import exp_so3

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
        self._remaining_exposures = 0
        self._max_readings = -1

    @property
    def is_waiting(self) -> bool:
        """Whether a search failed since the last restart."""
        return self._first_ns is not None

    def count_exposure(self) -> None:
        """Count an exposure of the tool's markers."""
        self._remaining_exposures -= 1

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
        return pause_ns >= MAX_PAUSE_NS or (
            self._remaining_exposures <= 0 and pause_ns >= enough_ns
        )

    def record_failure(self, time_ns: int, readings: int, exposures: int) -> None:
        """Record an unsuccessful search.

        Args:
            time_ns: time of the latest exposure [ns].
            readings: number of readings that the search had.
            exposures: smallest number of exposures until the next search.
        """
        if self._first_ns is None or readings > self._max_readings:
            self._first_ns, self._max_readings = time_ns, readings
        self._failed_ns, self._remaining_exposures = time_ns, exposures


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
    return _Search(model, centred, exposures, common_errors, settings).acquire()


@dataclass(frozen=True, eq=False)
class _Search:
    """Search for a tool in exposures; the arguments are those of acquire_strobed."""

    model: MeasurementModel
    centred: CentredMarkers
    exposures: Sequence[MarkerExposure]
    common_errors: int
    settings: ToolTrackerSettings

    @cached_property
    def readings_px(self) -> Array:
        """Readings of all exposures, shape (exposures, S)."""
        return np.array([one.readings_px for one in self.exposures])

    @cached_property
    def count(self) -> int:
        """Number of readings."""
        return int(np.isfinite(self.readings_px).sum())

    def acquire(self) -> StrobedAcquisition:
        model, centred, fit = self.model, self.centred, self.settings.fit
        if self.count < STATES + fit.min_redundancy:
            return StrobedAcquisition(
                None,
                f"{self.count} readings so far; pose and velocity take {STATES} and "
                f"{fit.min_redundancy} more to check them",
            )
        readings, sigma, age_s = self.latest_per_marker()
        reason = missing_readings(centred, np.isfinite(readings), fit)
        if reason is not None:
            return StrobedAcquisition(None, reason)
        centre = rough_position(model, readings, sigma)
        if centre is None:
            return StrobedAcquisition(None, "the readings' planes do not determine a position")
        # Standard deviations that include the possible motion since each reading.
        px_per_mm = np.linalg.norm(model.linearise(centre[None])[1][0], axis=1)
        px_per_mm = np.where(np.isfinite(px_per_mm), px_per_mm, 0.0)
        sigma = np.hypot(sigma, self.settings.motion.velocity_sigma_mm_s * age_s * px_per_mm)
        starts = initial_poses_from_readings(model, centred, readings, sigma)
        if not len(starts[0]):
            reason = self.too_few_sensors() or "the readings do not determine a rotation"
            return StrobedAcquisition(None, reason, searched=True)
        candidates = solutions(PoseEquations(model, centred, readings, sigma), *starts)
        return replace(self.best_candidate(candidates), searched=True)

    def best_candidate(self, candidates: PoseCandidates) -> StrobedAcquisition:
        """Return the best state that the filter reaches from rough poses, if it is unambiguous."""
        poses = zip(candidates.rotation, candidates.centroid_mm, strict=True)
        accepted = [
            solution
            for rotation, centroid_mm in islice(poses, MAX_CANDIDATES)
            if (solution := self.iterate_filter(rotation, centroid_mm)) is not None
        ]
        if not accepted:
            reason = self.too_few_sensors()
            if reason is not None:
                return StrobedAcquisition(None, reason)
            reason = f"{self.count} readings of {len(self.exposures)} exposures do not fit the tool"
            return StrobedAcquisition(None, reason, inconsistent=True)
        best, *others = sorted(accepted, key=lambda one: one.nis)
        limit = best.nis + self.settings.fit.ambiguity_chi2_margin
        rivals = [one for one in others if one.nis <= limit and self.differ(best, one)]
        if rivals:
            return StrobedAcquisition(
                None,
                f"the readings fit the tool in {1 + len(rivals)} ways: chi2 is {best.nis:.4g} and "
                f"{rivals[0].nis:.4g}",
                inconsistent=True,
            )
        return best

    def too_few_sensors(self) -> str | None:
        """Return a reason where no more than two sensors saw the tool.

        A moving tool that only two sensors see is often not found although its readings are right:
        its motion between the exposures is large compared with what they determine.
        """
        which = np.flatnonzero(np.isfinite(self.readings_px).any(axis=0)) + 1
        if len(which) >= MIN_SENSORS:
            return None
        names = " and ".join(str(one) for one in which)
        return (
            f"only sensor{'' if len(which) == 1 else 's'} {names} of {self.readings_px.shape[1]} "
            f"saw it; its readings do not tell where it is, {MIN_SENSORS} sensors are needed to "
            "find it"
        )

    def latest_per_marker(self) -> tuple[Array, Array, Array]:
        """Return the latest readings and sigmas of each marker (M, S), and their age (M, 1) [s]."""
        shape = len(self.centred.markers_mm), len(self.model)
        readings, sigma, age = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape[0])
        for one in self.exposures:
            readings[one.marker], sigma[one.marker] = one.readings_px, one.sigma_px
            age[one.marker] = 1e-9 * (self.exposures[-1].time_ns - one.time_ns)
        return readings, sigma, age[:, None]

    def iterate_filter(self, rotation: Array, centroid_mm: Array) -> StrobedAcquisition | None:
        """Filter the exposures repeatedly from an initial pose; None where they do not fit."""
        motion, fit, readings = self.settings.motion, self.settings.fit, self.count
        begin_ns = self.exposures[0].time_ns
        span_s = 1e-9 * (self.exposures[-1].time_ns - begin_ns)
        position_sigma = (
            INITIAL_POSITION_SIGMA_FRACTION * self.centred.radius_mm
            + motion.velocity_sigma_mm_s * span_s
        )
        broad = np.diag([INITIAL_ROTATION_SIGMA_RAD**2] * 3 + [position_sigma**2] * 3)
        state = initial_state(begin_ns, rotation, centroid_mm, broad, motion, self.common_errors)
        for iteration in range(PASSES - 1):
            filtered = self.filter_pass(state, robust=iteration > 1)
            if filtered is None or filtered.state is None:
                return None
            end_state = filtered.state
            # The next pass starts from this state; the broad prior stays.
            state = replace(
                state,
                rotation=exp_so3(-span_s * end_state.angular_velocity_rad_s) @ end_state.rotation,
                centroid_mm=end_state.centroid_mm - span_s * end_state.velocity_mm_s,
                velocity_mm_s=end_state.velocity_mm_s,
                angular_velocity_rad_s=end_state.angular_velocity_rad_s,
            )
        # Beyond these limits the last pass cannot be accepted any more: it ends early.
        filtered = self.filter_pass(
            state,
            robust=True,
            max_nis=chi2_limit(readings - 6, fit.false_rejection_probability),
            max_excluded=(1.0 - MIN_CONSISTENT_FRACTION) * readings,
        )
        if (
            filtered is None
            or filtered.readings < STATES + fit.min_redundancy
            or filtered.readings < MIN_CONSISTENT_FRACTION * readings
        ):
            return None
        limit = chi2_limit(filtered.readings - 6, fit.false_rejection_probability)
        return filtered if filtered.nis <= limit else None

    def filter_pass(
        self,
        state: PoseState,
        *,
        robust: bool,
        max_nis: float = np.inf,
        max_excluded: float = np.inf,
    ) -> StrobedAcquisition | None:
        """Filter the exposures once; None where an exposure, or all together, do not fit."""
        nis, count, excluded = 0.0, 0, 0
        for one in self.exposures:
            state = predict(state, one.time_ns, self.settings.motion)
            sensors = np.flatnonzero(np.isfinite(one.readings_px))
            if len(sensors) == 0:
                continue
            lit = np.array([one.marker])
            arms = self.centred.markers_mm[lit] @ state.rotation.T
            expected = self.model.predict(arms + state.centroid_mm, with_common_errors=True)
            if not np.isfinite(expected.reading_px[0, sensors]).all():
                return None
            common = common_jacobian(expected, lit, state.common.shape[1])
            prediction = predict_measurement(state, arms, expected, common)
            if len(sensors) < len(self.model):
                prediction = prediction.of(sensors)
            residual, sigma = one.readings_px[sensors] - prediction.value_px, one.sigma_px[sensors]
            updated: FilterUpdate | None
            if robust:
                gate_probability = self.settings.gate_probability
                updated = robust_update(state, prediction, residual, sigma, gate_probability)
            else:
                updated = update(state, prediction, residual, sigma)
            if updated is None:
                return None
            state = updated.state
            nis += updated.nis
            count += len(updated.accepted)
            excluded += len(sensors) - len(updated.accepted)
            if nis > max_nis or excluded > max_excluded + 0.5:
                return None
        return StrobedAcquisition(state, None, False, nis, count)

    def differ(self, first: StrobedAcquisition, second: StrobedAcquisition) -> bool:
        """Return whether two states have a marker at different positions."""
        markers = [
            one.state.marker_positions(self.centred)
            for one in (first, second)
            if one.state is not None
        ]
        return bool(np.ptp(markers, axis=0).max() > SAME_POSE_FRACTION * self.centred.radius_mm)
