"""The thesis's trackers, exposure by exposure, beside the live tracker."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.tracking.settings import TrackerSettings
from validation.result_tables import ResultTable
from validation.section_6.spatial_tracks import NEAR_MM, SpaceTracks, TrackingSettings
from validation.section_6_2.track_quality import (
    TrackQuality,
    mean_track_quality,
    spatial_track_quality,
)
from validation.thesis_tracking.settings import ThesisSettings

Array = NDArray[np.float64]
TrackFunction = Callable[[TrackingSettings], tuple[SpaceTracks, Array]]
"""Follows a recording; returns tracks, and where the markers are, (N, M, 3)."""

OURS: Final = "readings"


def live_methods(
    max_velocity_px_s: float, limit_px_s: float | None, jerk_psd: float
) -> dict[str, TrackingSettings]:
    """Return the methods that a device can follow markers by, told how fast these are."""

    def thesis(**given: object) -> ThesisSettings:
        return ThesisSettings(
            max_velocity_px_s=max_velocity_px_s,
            velocity_limit_px_s=limit_px_s,
            jerk_psd=jerk_psd,
            **given,  # type: ignore[arg-type]
        )

    return {
        "window": thesis(method="window"),
        "window, by prediction": thesis(method="window", window_decision="prediction"),
        "probabilistic": thesis(method="probabilistic"),
        "probabilistic, curve, 5 px": thesis(
            method="probabilistic", interval_velocity="curve", min_interval_px=5.0
        ),
        "eight-state": thesis(method="eight-state"),
        OURS: TrackerSettings(),
    }


def live_table(
    scenes: Iterable[tuple[str, Sequence[TrackFunction]]], methods: dict[str, TrackingSettings]
) -> tuple[ResultTable, dict[tuple[str, str], TrackQuality]]:
    """Return how the methods hold the markers of scenes in space.

    Args:
        scenes: names, and what follows each of their recordings.
        methods: by name.
    """
    track_qualities, rows = {}, []
    for scene, recordings in scenes:
        for name, settings in methods.items():
            found = [follow(settings) for follow in recordings]
            hold = mean_track_quality([spatial_track_quality(tracks) for tracks, _ in found])
            off = np.concatenate(
                [
                    np.linalg.norm(tracks.position_mm - truth, axis=2).ravel()
                    for tracks, truth in found
                ]
            )
            off = off[~np.isnan(off)]
            rms = float(np.sqrt(np.mean(off**2))) if len(off) else float("nan")
            track_qualities[scene, name] = hold
            rows.append(
                (
                    scene, name, round(hold.first, 4), round(hold.wrong, 4), round(hold.lost, 4),
                    hold.exchanged, hold.false, rms, float(np.median(off)) if len(off) else rms,
                )
            )  # fmt: skip
    return (
        ResultTable(
            "tracked exposure by exposure, as a device does live, on our peaks: "
            "share of markers and exposures on the marker's first track, on one that began "
            "elsewhere, on none; how often a marker's track became another one; false tracks; RMS "
            f"and median error in space of what is within {NEAR_MM:g} mm [mm]",
            ("scene", "method", "first", "wrong", "lost", "exchanged", "false", "RMS", "median"),
            tuple(rows),
        ),
        track_qualities,
    )
