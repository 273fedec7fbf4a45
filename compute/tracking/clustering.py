"""Clusters of tracks that compete for peaks of one sensor."""

from collections.abc import Iterator
from math import sqrt

from compute.tracking.joint_events import SHARED_PEAK_REACH, ClusterTrack
from compute.tracking.settings import TrackerSettings

Peak = tuple[int, float, float]
"""Index, position [px] and variance [px^2]."""


def split_clusters(
    cluster_tracks: list[ClusterTrack], peaks: list[Peak], settings: TrackerSettings
) -> Iterator[tuple[list[int], list[Peak]]]:
    """Yield the members of each cluster, in order, and its peaks.

    Tracks are in one cluster when a peak lies in the gates of both, or when they lie so near to
    one another that they may share one, directly or through others.
    """
    if not cluster_tracks:
        return
    merge = SHARED_PEAK_REACH * settings.resolution_px

    def reach(member: int) -> float:
        return settings.gate_sigma * sqrt(cluster_tracks[member].variance_px2)

    groups: list[list[int]] = []
    end = -float("inf")
    widest = max((sqrt(variance) for _, _, variance in peaks), default=0.0)
    margin = settings.gate_sigma * widest
    for member in sorted(
        range(len(cluster_tracks)), key=lambda m: cluster_tracks[m].reading_px - reach(m)
    ):
        middle, half = cluster_tracks[member].reading_px, reach(member) + margin
        if not groups or middle - half > end + 2.0 * merge:
            groups.append([])
            end = -float("inf")
        groups[-1].append(member)
        end = max(end, middle + half)
    for group in groups:
        low = min(cluster_tracks[m].reading_px - reach(m) for m in group) - margin - merge
        high = max(cluster_tracks[m].reading_px + reach(m) for m in group) + margin + merge
        yield sorted(group), [peak for peak in peaks if low <= peak[1] <= high]
