"""Monte Carlo correspondence of many markers: resolved, ambiguous and wrong exposures."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.grouping import Correspondence, group_peaks
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.signal.peaks import PeakFlag
from validation.marker_capacity.rigs import RIGS, Rig, with_noise

Array = NDArray[np.float64]

MARKERS: Final = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20)
FRAMES: Final = 16
MERGED_PX: Final = 1.0
"""Lines nearer than this are one peak, flagged as merged, at their middle."""
PREDICTED_MM: Final = 2.0
"""Deviation of predicted points, where there are any, in each coordinate."""


@dataclass(frozen=True)
class Scene:
    """What frames are like.

    Args:
        label: in tables.
        noise_px: of readings beside the rig's own.
        missed_fraction: chance that a sensor has no peak of a marker.
        false: expected number of false peaks of a sensor, by marker.
        predicted: whether tracks say where the markers are expected.
    """

    label: str
    noise_px: float
    missed_fraction: float = 0.0
    false: float = 0.0
    predicted: bool = False


SCENES: Final = (
    Scene("noise at the bound", 0.0),
    Scene("with 0.1 px", 0.1),
    Scene("5 % missed, 5 % false", 0.0, 0.05, 0.05),
    Scene("with 0.1 px and predictions", 0.1, predicted=True),
)


@dataclass(frozen=True)
class Shares:
    """Outcomes of frames, and of the groups in them.

    Args:
        resolved: share of frames with every marker grouped rightly and without doubt.
        ambiguous: share with a marker marked as ambiguous or left out, and nothing wrong unmarked.
        wrong: share with a group that is wrong and not marked.
        markers: share of the markers that were grouped rightly and without doubt.
        groups: groups that were not marked.
        wrong_groups: of those, the wrong ones.
    """

    resolved: float
    ambiguous: float
    wrong: float
    markers: float
    groups: int
    wrong_groups: int


@dataclass(frozen=True, eq=False)
class Frame:
    """Peaks of N markers on S sensors.

    Args:
        places_mm: of the markers, shape (N, 3).
        position_px, sigma_px: shape (S, K).
        merged: shape (S, K).
        owners: of each peak, by sensor.
    """

    places_mm: Array
    position_px: Array
    sigma_px: Array
    merged: NDArray[np.bool_]
    owners: tuple[tuple[frozenset[int], ...], ...]


def expose(rig: Rig, scene: Scene, markers: int, rng: np.random.Generator) -> Frame:
    """Draw markers evenly in the volume, where all sensors see them, and read them."""
    positions = np.empty((0, 3))
    while len(positions) < markers:
        more = rig.box.uniform(4 * markers, rng)
        readings = rig.cameras.project(more)
        seen = ((readings >= 0.0) & (readings <= rig.pixels - 1.0)).all(axis=1)
        positions = np.concatenate([positions, more[seen]])[:markers]
    readings = rig.cameras.project(positions)
    readings += rig.sigma_px * rng.standard_normal(readings.shape)
    there = rng.random(readings.shape) >= scene.missed_fraction
    lines: list[list[tuple[float, frozenset[int]]]] = []
    for sensor in range(rig.sensors):
        own = [
            (float(readings[marker, sensor]), frozenset({marker}))
            for marker in np.flatnonzero(there[:, sensor]).tolist()
        ]
        false = rng.poisson(scene.false * markers)
        low, high = float(readings[:, sensor].min()), float(readings[:, sensor].max())
        stray = rng.uniform(max(low - 100.0, 0.0), min(high + 100.0, rig.pixels - 1.0), false)
        lines.append(_merged(sorted([*own, *((float(x), frozenset({-1})) for x in stray)])))
    most = max(1, *(len(line) for line in lines))
    position = np.full((rig.sensors, most), np.nan)
    both = np.zeros(position.shape, dtype=np.bool_)
    for sensor, line in enumerate(lines):
        position[sensor, : len(line)] = [place for place, _ in line]
        both[sensor, : len(line)] = [len(owner) > 1 for _, owner in line]
    sigma = np.where(np.isfinite(position), rig.sigma_px[:, None], np.nan)
    owners = tuple(tuple(owner for _, owner in line) for line in lines)
    return Frame(positions, position, sigma, both, owners)


def _merged(line: list[tuple[float, frozenset[int]]]) -> list[tuple[float, frozenset[int]]]:
    kept: list[tuple[float, frozenset[int]]] = []
    for place, owner in line:
        if kept and place - kept[-1][0] < MERGED_PX:
            kept[-1] = (0.5 * (kept[-1][0] + place), kept[-1][1] | owner)
        else:
            kept.append((place, owner))
    return kept


def group(rig: Rig, scene: Scene, frame: Frame, rng: np.random.Generator) -> Correspondence:
    """Group a frame's peaks, with what the scene lets one know."""
    predicted = None
    if scene.predicted:
        away = PREDICTED_MM * rng.standard_normal(frame.places_mm.shape)
        spread = np.tile(PREDICTED_MM**2 * np.eye(3), (len(away), 1, 1))
        predicted = PredictedPoints(frame.places_mm + away, spread)
    return group_peaks(
        rig.solver.solve,
        Measurements.of(
            frame.position_px,
            frame.sigma_px,
            np.where(frame.merged, PeakFlag.MERGED, 0).astype(np.int32),
        ),
        model=rig.model,
        predicted=predicted,
    )


def owners_of_peaks(frame: Frame, choice: Sequence[int]) -> frozenset[int]:
    """Return the markers that all of a group's peaks are of: none, if it is wrong."""
    owners = [frame.owners[sensor][peak] for sensor, peak in enumerate(choice) if peak >= 0]
    return frozenset.intersection(*owners) - {-1}


@cache
def capacity(rig_index: int, scene: Scene, markers: int, frames: int = FRAMES) -> Shares:
    """Group frames of so many markers; random numbers are by configuration and number."""
    rig = with_noise(RIGS[rig_index](), scene.noise_px)
    rng = np.random.default_rng([rig_index, SCENES.index(scene), markers])
    resolved = wrong_frames = right = groups = wrong_groups = 0
    for _ in range(frames):
        frame = expose(rig, scene, markers, rng)
        found = group(rig, scene, frame, rng)
        whole, errors = 0, 0
        for choice, ambiguous in zip(found.peaks.tolist(), found.ambiguous.tolist(), strict=True):
            if ambiguous:
                continue
            right_one = bool(owners_of_peaks(frame, choice))
            whole += right_one
            errors += not right_one
        groups += whole + errors
        wrong_groups += errors
        right += whole
        wrong_frames += errors > 0
        resolved += whole == markers and errors == 0
    return Shares(
        resolved / frames,
        1.0 - (resolved + wrong_frames) / frames,
        wrong_frames / frames,
        right / (frames * markers),
        groups,
        wrong_groups,
    )
