"""Strobed start: a tool found from exposures of its markers one after the other.

While the markers are lit in turn the tool moves: its last readings fit no single pose. They tell
one roughly, with a deviation that grows with their age; from there a filter runs over the
exposures, from a start that says next to nothing, until it comes to rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.association import common_slopes, robust_update
from compute.pose.marker_frame import MarkerFrame
from compute.pose.observability import missing_readings
from compute.pose.pose_equations import PoseEquations, Poses
from compute.pose.pose_filter import (
    STATES,
    PoseState,
    Update,
    innovations,
    predict,
    resting_state,
    update,
)
from compute.pose.pose_fit import solutions
from compute.pose.pose_start import rough_place, starts_from_readings
from compute.pose.reading_model import ReadingModel
from compute.pose.settings import ToolTrackerSettings
from compute.pose.small import one_rotation
from compute.reconstruction.points import chi2_limit

Array = NDArray[np.float64]

PASSES: Final = 4
CANDIDATES: Final = 4
BROAD_RAD: Final = 0.2
BROAD_SHARE: Final = 0.5
"""Deviation of a start's place as a share of the markers' radius, besides what the motion adds."""
AGREEING_SHARE: Final = 0.8
"""Of the readings, that must fit: with more left out the rest may fit by chance."""
LEAST_SENSORS: Final = 3
"""That find a moving tool whatever the sensors' places; two do only of some."""
SAME_SHARE: Final = 0.02
"""States whose markers lie nearer than this share of the radius are one: passes end near, not at,
the same place."""


@dataclass(frozen=True, eq=False)
class Exposure:
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
    def shows(self) -> bool:
        """Whether any sensor saw the marker."""
        return bool(np.isfinite(self.readings_px).any())


@dataclass(frozen=True, eq=False)
class StrobedStart:
    """A tool found, or why it was not.

    Args:
        state: at the last exposure; None: not found.
        reason: why not; None if it was.
        unfit: whether there were readings enough and they did not fit.
        nis: normalised innovation squared of all readings.
        readings: their number.
        searched: whether it was looked for all over, which takes long.
    """

    state: PoseState | None
    reason: str | None
    unfit: bool = False
    nis: float = 0.0
    readings: int = 0
    searched: bool = False


def find_strobed(
    model: ReadingModel,
    frame: MarkerFrame,
    exposures: Sequence[Exposure],
    errors: int,
    settings: ToolTrackerSettings,
) -> StrobedStart:
    """Find a tool from the last exposures of its markers, oldest first.

    Args:
        model: the cameras.
        frame: the tool's markers.
        exposures: of its markers only.
        errors: number of common errors that the state is to carry.
        settings: of fits and motion.
    """
    count = sum(int(np.isfinite(one.readings_px).sum()) for one in exposures)
    if count < STATES + settings.fit.least_redundancy:
        return StrobedStart(
            None,
            f"{count} readings so far; pose and velocity take {STATES} and "
            f"{settings.fit.least_redundancy} more to check them",
        )
    readings, sigma, age_s = _last_of_each(exposures, len(frame.markers_mm), model.sensors)
    reason = missing_readings(frame, np.isfinite(readings), settings.fit)
    if reason is not None:
        return StrobedStart(None, reason)
    smeared = _smeared(model, readings, sigma, age_s, settings.motion.speed_mm_s)
    if smeared is None:
        return StrobedStart(None, "the readings' planes tell no place")
    starts = starts_from_readings(model, frame, readings, smeared)
    if not len(starts[0]):
        reason = _too_few_sensors(exposures) or "the readings tell no turn"
        return StrobedStart(None, reason, searched=True)
    equations = PoseEquations(model, frame, readings, smeared)
    found = _best(model, frame, exposures, solutions(equations, *starts), errors, settings)
    return replace(found, searched=True)


def _best(
    model: ReadingModel,
    frame: MarkerFrame,
    exposures: Sequence[Exposure],
    found: Poses,
    errors: int,
    settings: ToolTrackerSettings,
) -> StrobedStart:
    """Return what the likeliest of the rough poses come to, if it is one."""
    settled: list[StrobedStart] = []
    for candidate in range(min(CANDIDATES, len(found.chi2))):
        one = _settle(
            model,
            frame,
            exposures,
            found.rotation[candidate],
            found.centroid_mm[candidate],
            errors,
            settings,
        )
        if one is not None:
            settled.append(one)
    if not settled:
        reason = _too_few_sensors(exposures)
        if reason is not None:
            return StrobedStart(None, reason)
        count = sum(int(np.isfinite(one.readings_px).sum()) for one in exposures)
        return StrobedStart(
            None, f"{count} readings of {len(exposures)} exposures do not fit the tool", unfit=True
        )
    settled.sort(key=lambda one: one.nis)
    best = settled[0]
    rivals = [
        one
        for one in settled[1:]
        if one.nis <= best.nis + settings.fit.distinct_chi2 and _apart(frame, best, one)
    ]
    if rivals:
        return StrobedStart(
            None,
            f"the readings fit the tool in {1 + len(rivals)} ways: chi2 is {best.nis:.4g} and "
            f"{rivals[0].nis:.4g}",
            unfit=True,
        )
    return best


def _too_few_sensors(exposures: Sequence[Exposure]) -> str | None:
    """Return that no more than two sensors saw the tool, if so.

    A moving tool of which two sensors see each marker is often not found, right as its readings
    are: what it did between the exposures is too much beside what they tell.
    """
    readings = np.array([one.readings_px for one in exposures])
    seen: NDArray[np.bool_] = np.isfinite(readings).any(axis=0)
    which = np.flatnonzero(seen) + 1
    if len(which) > LEAST_SENSORS - 1:
        return None
    names = " and ".join(str(one) for one in which)
    return (
        f"only sensor{'' if len(which) == 1 else 's'} {names} of {len(seen)} saw it; its readings "
        f"do not tell where it is, {LEAST_SENSORS} sensors are needed to find it"
    )


def _last_of_each(
    exposures: Sequence[Exposure], markers: int, sensors: int
) -> tuple[Array, Array, Array]:
    """Return the last readings and deviations of each marker (M, S), and their age (M, 1) [s]."""
    readings, sigma = np.full((markers, sensors), np.nan), np.full((markers, sensors), np.nan)
    age = np.zeros((markers, 1))
    for one in exposures:
        readings[one.marker], sigma[one.marker] = one.readings_px, one.sigma_px
        age[one.marker] = 1e-9 * (exposures[-1].time_ns - one.time_ns)
    return readings, sigma, age


def _smeared(
    model: ReadingModel, readings_px: Array, sigma_px: Array, age_s: Array, speed_mm_s: float
) -> Array | None:
    """Return deviations that hold what the tool may have moved since each reading, (M, S)."""
    place = rough_place(model, readings_px, sigma_px)
    if place is None:
        return None
    slope = np.linalg.norm(model.expected(place[None])[1][0], axis=1)
    slope = np.where(np.isfinite(slope), slope, 0.0)
    found: Array = np.hypot(sigma_px, speed_mm_s * age_s * slope)
    return found


def _settle(
    model: ReadingModel,
    frame: MarkerFrame,
    exposures: Sequence[Exposure],
    rotation: Array,
    centroid_mm: Array,
    errors: int,
    settings: ToolTrackerSettings,
) -> StrobedStart | None:
    """Filter the exposures from a start, again and again; None where they do not fit."""
    motion = settings.motion
    span_s = 1e-9 * (exposures[-1].time_ns - exposures[0].time_ns)
    place_sd = BROAD_SHARE * frame.radius_mm + motion.speed_mm_s * span_s
    broad = np.diag([BROAD_RAD**2] * 3 + [place_sd**2] * 3)
    begin, end = exposures[0].time_ns, exposures[-1].time_ns
    state = resting_state(begin, rotation, centroid_mm, broad, motion, errors)
    offered = sum(int(np.isfinite(one.readings_px).sum()) for one in exposures)
    probability = settings.fit.inconsistent_probability
    for turn in range(PASSES):
        last = turn == PASSES - 1
        # No more than all that is offered can fit: what is beyond that is not waited for.
        most_nis = chi2_limit(offered - 6, probability) if last else np.inf
        most_left_out = (1.0 - AGREEING_SHARE) * offered if last else np.inf
        passed = _passed(
            model,
            frame,
            exposures,
            state,
            settings,
            robust=turn > 1,
            most_nis=most_nis,
            most_left_out=most_left_out,
        )
        found = None if passed is None else passed.state
        if passed is None or found is None:
            return None
        if last:
            limit = chi2_limit(passed.readings - 6, probability)
            enough = passed.readings >= STATES + settings.fit.least_redundancy
            enough &= passed.readings >= AGREEING_SHARE * offered
            return passed if enough and passed.nis <= limit else None
        # Where the next pass is linearised; what is known in advance stays next to nothing.
        state = replace(
            state,
            rotation=one_rotation(-1e-9 * (end - begin) * found.turn_rate_rad_s) @ found.rotation,
            centroid_mm=found.centroid_mm - 1e-9 * (end - begin) * found.velocity_mm_s,
            velocity_mm_s=found.velocity_mm_s,
            turn_rate_rad_s=found.turn_rate_rad_s,
        )
    return None


def _passed(
    model: ReadingModel,
    frame: MarkerFrame,
    exposures: Sequence[Exposure],
    state: PoseState,
    settings: ToolTrackerSettings,
    *,
    robust: bool,
    most_nis: float,
    most_left_out: float,
) -> StrobedStart | None:
    """Filter the exposures once; None where one does not fit at all, or all fit too badly."""
    nis, count, left_out = 0.0, 0, 0
    taken: Update | None
    for one in exposures:
        state = predict(state, one.time_ns, settings.motion)
        seen = np.flatnonzero(np.isfinite(one.readings_px))
        if len(seen) == 0:
            continue
        lit = np.array([one.marker])
        arms = frame.markers_mm[lit] @ state.rotation.T
        expected = model.full(arms + state.centroid_mm)
        if not np.isfinite(expected.value_px[0, seen]).all():
            return None
        common = common_slopes(expected, lit, state.common.shape[1])
        told = innovations(state, arms, expected, common)
        if len(seen) < model.sensors:
            told = told.of(seen)
        residual = one.readings_px[seen] - told.value_px
        if robust:
            taken = robust_update(
                state, told, residual, one.sigma_px[seen], settings.gate_probability
            )
            if taken is None:
                return None
        else:
            taken = update(state, told, residual, one.sigma_px[seen])
        state = taken.state
        nis += taken.nis
        count += len(taken.kept)
        left_out += len(seen) - len(taken.kept)
        if nis > most_nis or left_out > most_left_out + 0.5:
            return None
    return StrobedStart(state, None, False, nis, count)


def _apart(frame: MarkerFrame, first: StrobedStart, second: StrobedStart) -> bool:
    """Return whether two states have a marker at different places."""
    assert first.state is not None
    assert second.state is not None
    distance = np.abs(first.state.places(frame) - second.state.places(frame)).max()
    return bool(distance > SAME_SHARE * frame.radius_mm)
