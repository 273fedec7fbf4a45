"""Many markers followed on readings: ``python -m benchmarks.tracking [--json]``.

2 to 20 markers, all lit at once, that cross in pairs within 1 to 5 mm, seen 100 times a second by 4
and 8 sensors with 0.05 px noise; 5 % of the peaks are missing, 5 % are false, and peaks nearer than
4 px are one. Beside ours, on the same readings and with the same model of motion (constant
acceleration, the same noise), Stone Soup's JPDA. Ours begins with nothing and finds the markers
itself; Stone Soup's is given them at the exposure from which on both are judged. ``interacting`` is
our default, without the peer's model.

GOSPA is Stone Soup's own, of order 2 with a cut-off of 20 mm: one marker that nobody follows makes
14 mm. ``switches`` counts how often a marker is followed by another track than before; ``nees`` is
the median of the squared position error in its covariance, 2.37 where that is right. Times are the
thread's own, of the exposures that are judged.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Sequence
from typing import Literal

import numpy as np

from benchmarks.tracking_peer import stone_soup
from benchmarks.tracking_scene import MISSED, PIXELS, SIGMA_PX, Scene, scene_of
from benchmarks.tracking_score import Tracked, score
from compute.tracking.settings import TrackerSettings
from compute.tracking.track_batch import TrackState
from compute.tracking.tracker import Tracker

Row = dict[str, str | int | float]

MARKERS = (2, 5, 10, 20)
SENSORS = (4, 8)
FIRST = 30
"""Exposure from which on trackers are judged."""
WHITE_JERK = 1e7
MARKER_EXPOSURES = 4000
"""Markers times judged exposures, over all seeds: the peer takes a second for one of 20 markers."""
Motion = Literal["acceleration", "interacting"]
METHODS: dict[str, Motion] = {
    "lumiline": "acceleration",
    "lumiline, interacting": "interacting",
}


def ours(scene: Scene, motion: Motion) -> list[Tracked]:
    """Return what our tracker reports, from the first exposure on."""
    settings = TrackerSettings(
        motion=motion,
        white_jerk=WHITE_JERK,
        detection=1.0 - MISSED,
        false_per_px=scene.false_per_px,
    )
    tracker = Tracker(scene.cameras, settings, pixels=(PIXELS,) * len(scene.cameras))
    found = []
    for at, peaks in zip(scene.times_s, scene.peaks_px, strict=True):
        sigma = np.full(peaks.shape, SIGMA_PX)
        flags = np.zeros(peaks.shape, dtype=np.int32)
        begin = time.thread_time()
        batch = tracker.step(round(at * 1e9), peaks, sigma, flags, None)
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
    """Measure all; rows of the same keys, means over the seeds."""
    rows: list[Row] = []
    for count in markers:
        for sensor_count in sensors:
            scores: dict[str, list[dict[str, float]]] = {}
            judged = max(MARKER_EXPOSURES // count // seeds, 40) if peer else frames
            for seed in range(seeds):
                scene = scene_of(count, sensor_count, min(frames, FIRST + judged), seed)
                places = scene.places_mm[FIRST:]
                if peer:
                    found = stone_soup(scene, FIRST, WHITE_JERK, 1.0 - MISSED)
                    scores.setdefault("Stone Soup JPDA", []).append(score(found, places))
                for name, motion in METHODS.items():
                    found = ours(scene, motion)[FIRST:]
                    scores.setdefault(name, []).append(score(found, places))
            rows += _rows(count, sensor_count, scores)
    return rows


def _rows(markers: int, sensors: int, scores: dict[str, list[dict[str, float]]]) -> list[Row]:
    means = {
        name: {key: statistics.fmean(one[key] for one in each) for key in each[0]}
        for name, each in scores.items()
    }
    base = means["lumiline"]["ms_per_frame"]
    return [
        {
            "markers": markers,
            "sensors": sensors,
            "method": name,
            **{key: value for key, value in mean.items() if key != "ms_per_frame"},
            "ms_per_frame": mean["ms_per_frame"],
            "times_ours": mean["ms_per_frame"] / base,
        }
        for name, mean in sorted(means.items())
    ]


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
