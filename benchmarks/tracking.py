"""Benchmark of tracking many markers: ``python -m benchmarks.tracking [--json]``.

2 to 20 markers, all lit at once, that cross in pairs within 1 to 5 mm, seen 100 times a second by 4
and 8 sensors with 0.05 px noise; 5 % of the peaks are missing, 5 % are false, and peaks nearer than
4 px are one. Beside ours, on the same readings and with the same model of motion (constant
acceleration, the same noise), Stone Soup's JPDA. It is given the markers' places (0.5 mm) and
velocities (20 mm/s) at the exposure from which on all are judged; so is ours in the rows ``given``.
In the rows ``finding`` ours begins with nothing and finds the markers itself in the 30 exposures
before. ``interacting`` is our default, without the peer's model.

GOSPA is Stone Soup's own, of order 2 with a cut-off of 20 mm: one marker that nobody follows makes
14 mm. ``switches`` counts how often a marker is followed by another track than before; ``nees`` is
the median of the squared position error in its covariance, 2.37 where that is right. Times are the
thread's own: ``ms_per_frame`` of the exposures that are judged, ``start_ms`` of those before,
``worst_ms`` the longest of all; ``peer_times`` is the peer's time over the row's.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.tracking_metrics import Tracked, score
from benchmarks.tracking_peer import stone_soup
from benchmarks.tracking_scene import (
    MISSED,
    PIXELS,
    SIGMA_PX,
    START_SIGMA,
    Scene,
    scene_of,
    starts_at,
)
from compute.measurement.measurements import Measurements
from compute.tracking.settings import TrackerSettings
from compute.tracking.track_batch import TrackState
from compute.tracking.tracker import Tracker

Array = NDArray[np.float64]
Row = dict[str, str | int | float]

MARKERS = (2, 5, 10, 20)
SENSORS = (4, 8)
FIRST = 30
"""Exposure from which on trackers are judged."""
WHITE_JERK = 1e7
MARKER_EXPOSURES = 4000
"""Markers times judged exposures, over all seeds: the peer takes a second for one of 20 markers."""
START_COVARIANCE = np.diag(np.repeat(START_SIGMA[:2], 3)) ** 2
STANDARD_ACCELERATION = TrackerSettings().start_acceleration_mm_s2
Motion = Literal["acceleration", "interacting"]
METHODS: dict[str, tuple[Motion, bool]] = {
    "lumiline, given": ("acceleration", True),
    "lumiline interacting, given": ("interacting", True),
    "lumiline, finding": ("acceleration", False),
    "lumiline interacting, finding": ("interacting", False),
}
PEER = "Stone Soup JPDA, given"


def ours(scene: Scene, motion: Motion, *, given: bool) -> list[Tracked]:
    """Return our tracker's reports from the first exposure on.

    Args:
        scene: what is seen.
        motion: the model.
        given: whether markers are given at exposure ``FIRST``; nothing is looked at before.
    """
    settings = TrackerSettings(
        motion=motion,
        jerk_psd=WHITE_JERK,
        detection_probability=1.0 - MISSED,
        clutter_density_per_px=scene.clutter_density_per_px,
        start_acceleration_mm_s2=START_SIGMA[2] if given else STANDARD_ACCELERATION,
    )
    tracker = Tracker(scene.cameras, settings, pixels=(PIXELS,) * len(scene.cameras))
    found = []
    for exposure, (at, peaks) in enumerate(zip(scene.times_s, scene.peaks_px, strict=True)):
        if given and exposure < FIRST:
            found.append(Tracked(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)), 0.0))
            continue
        sigma = np.full(peaks.shape, SIGMA_PX)
        flags = np.zeros(peaks.shape, dtype=np.int32)
        time_ns = round(at * 1e9)
        if given and exposure == FIRST:
            starts = starts_at(scene, FIRST)
            tracker.add_prior_tracks(
                time_ns, starts.position_mm, starts.velocity_mm_s, START_COVARIANCE
            )
        begin = time.thread_time()
        batch = tracker.step(time_ns, Measurements.of(peaks, sigma, flags), None)
        seconds = time.thread_time() - begin
        good = batch.state != TrackState.TENTATIVE
        found.append(
            Tracked(
                batch.identity[good],
                batch.position_mm[good],
                batch.covariance[good][:, :3, :3],
                seconds,
            )
        )
    return found


def run(
    markers: Sequence[int] = MARKERS,
    sensors: Sequence[int] = SENSORS,
    seeds: int = 3,
    frames: int = 150,
    *,
    peer: bool = True,
) -> list[Row]:
    """Measure all trackers; rows of the same keys, means over the seeds."""
    rows: list[Row] = []
    for count in markers:
        for sensor_count in sensors:
            scores: dict[str, list[dict[str, float]]] = {}
            evaluated = max(MARKER_EXPOSURES // count // seeds, 40) if peer else frames
            for seed in range(seeds):
                scene = scene_of(count, sensor_count, min(frames, FIRST + evaluated), seed)
                positions = scene.positions_mm[FIRST:]
                if peer:
                    found = stone_soup(scene, FIRST, WHITE_JERK, 1.0 - MISSED)
                    scores.setdefault(PEER, []).append(_scored([], found, positions))
                for name, (motion, given) in METHODS.items():
                    found = ours(scene, motion, given=given)
                    one = _scored([] if given else found[:FIRST], found[FIRST:], positions)
                    scores.setdefault(name, []).append(one)
            rows += _rows(count, sensor_count, scores)
    return rows


def _rows(markers: int, sensors: int, scores: dict[str, list[dict[str, float]]]) -> list[Row]:
    means = {
        name: {key: statistics.fmean(one[key] for one in each) for key in each[0]}
        for name, each in scores.items()
    }
    peer = means[PEER]["ms_per_frame"] if PEER in means else float("nan")
    return [
        {
            "markers": markers,
            "sensors": sensors,
            "method": name,
            **mean,
            "peer_times": peer / mean["ms_per_frame"],
        }
        for name, mean in sorted(means.items())
    ]


def _scored(before: list[Tracked], evaluated: list[Tracked], positions: Array) -> dict[str, float]:
    found = score(evaluated, positions)
    start = 1e3 * statistics.fmean(one.seconds for one in before) if before else 0.0
    worst = 1e3 * max(one.seconds for one in [*before, *evaluated])
    return {**found, "start_ms": start, "worst_ms": worst}


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows as a table, or as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.tracking", description=__doc__)
    parser.add_argument("--markers", type=int, nargs="*", default=MARKERS, help="numbers of them")
    parser.add_argument("--sensors", type=int, nargs="*", default=SENSORS, help="numbers of them")
    parser.add_argument("--seeds", type=int, default=3, help="scenes of each kind")
    parser.add_argument("--frames", type=int, default=150, help="exposures of a scene")
    parser.add_argument("--alone", action="store_true", help="leave Stone Soup out")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    rows = run(
        options.markers, options.sensors, options.seeds, options.frames, peer=not options.alone
    )
    if options.json:
        json.dump(rows, sys.stdout, indent=2)
        print()
        return 0
    from benchmarks.signal import print_rows

    print_rows("markers followed on readings, beside Stone Soup; one thread", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
