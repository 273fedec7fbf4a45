"""Joint association events of the tracks that compete for a sensor's peaks (JPDA)."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import exp, log, pi, prod, sqrt

from compute.tracking.settings import TrackerSettings

Peak = tuple[int, float, float]
"""Index, position [px] and variance [px^2]."""
SHARED_PEAK_REACH = 2.0
"""Predictions nearer than this, in ``resolution_px``, and two deviations may share a peak."""
_LOG_2 = log(2.0)
MIN_MERGE_PROBABILITY = 1e-4
"""Probability below which two tracks are not considered merged into one peak."""
NEGLIGIBLE_WEIGHT_RATIO = 1e-6
"""Partial hypotheses bounded by this fraction of the most probable one's weight are pruned."""
SHARE_FRACTION_VARIANCE = 1.0 / 12.0
"""Variance of one marker's unknown, uniformly distributed share in a merged peak."""


@dataclass(frozen=True)
class ClusterTrack:
    """A track in a cluster: its predicted reading by one sensor, and the variance of that."""

    reading_px: float
    variance_px2: float


@dataclass(frozen=True)
class Marginals:
    """A peak as the reading of one track, with its marginal association probability.

    Args:
        peak: its index in the line.
        probability: probability of it.
        difference_px: reading less prediction.
        variance_px2: of the reading's noise.
        merged: whether the peak is shared with another track.
    """

    peak: int
    probability: float
    difference_px: float
    variance_px2: float
    merged: bool


@dataclass(frozen=True)
class _Option:
    """Assignment of a peak to one track, or to two that share it."""

    tracks: tuple[int, ...]
    peak: int
    weight: float


@dataclass(frozen=True)
class _Partial:
    weight: float
    options: tuple[_Option, ...]
    used_peaks: int
    assigned_tracks: int


def merge_probability(apart_px: float, variance_px2: float, resolution_px: float) -> float:
    """Return the probability that two peaks are found as one.

    ``exp(-log 2 (d / resolution_px)^2)`` (W. Koch, G. van Keuk, Multiple hypothesis track
    maintenance with possibly unresolved measurements, 1997), averaged over the distribution of the
    distance d.

    Args:
        apart_px: mean of the distance [px].
        variance_px2: variance of the distance [px^2].
        resolution_px: distance at which the probability is one half [px].
    """
    variance_factor = 1.0 + 2.0 * _LOG_2 * variance_px2 / resolution_px**2
    return exp(-_LOG_2 * apart_px**2 / (resolution_px**2 * variance_factor)) / sqrt(variance_factor)


def event_marginals(
    cluster_tracks: list[ClusterTrack],
    peaks: list[Peak],
    settings: TrackerSettings,
) -> tuple[list[list[Marginals]], float]:
    """Return each track's marginals, and a bound on the weight of pruned hypotheses.

    All events of non-negligible weight, while they are few; beyond, the most likely partial events
    are extended track by track, and the weight of the pruned ones is bounded.

    Each track is read as a peak of its own, shares one with another track, or is missed. Of
    hypotheses with the same peaks for the same tracks only the most probable counts: the average
    over exchanged tracks would draw two that run side by side into one (JPDA*: H. A. P. Blom,
    E. A. Bloem, 10.1109/9.839947). A shared peak lies anywhere between its two markers: it is
    their mean, with the variance of a share that is not known, of which each track takes its own
    part.

    Args:
        cluster_tracks: the cluster's tracks.
        peaks: index, position [px] and variance [px^2] of the peaks that they compete for.
        settings: detection, false peaks, merging, gate, most hypotheses.

    Returns:
        Marginals of each track, and the largest weight of hypotheses that were pruned, in parts of
        all that were kept; 0 where all were.
    """
    merge_probabilities = {
        (one, two): merge_probability(
            a.reading_px - b.reading_px, a.variance_px2 + b.variance_px2, settings.resolution_px
        )
        for one, a in enumerate(cluster_tracks)
        for two, b in enumerate(cluster_tracks)
        if one < two
    }
    options = [
        _options(track, cluster_tracks, peaks, merge_probabilities, settings)
        for track in range(len(cluster_tracks))
    ]
    missed = 1.0 - settings.detection_probability
    # What a track can multiply a hypothesis by, all its options together; 1 in a shared peak.
    max_factor = [
        max(missed + sum(option.weight for option in track_options), 1.0)
        for track_options in options
    ]
    partials = [_Partial(1.0, (), 0, 0)]
    pruned_weight = 0.0
    min_weight = NEGLIGIBLE_WEIGHT_RATIO * _greedy(options, missed)
    for track, track_options in enumerate(options):
        grown: list[_Partial] = []
        for partial in partials:
            if partial.assigned_tracks >> track & 1:
                # Another track has it in a shared peak already.
                grown.append(partial)
                continue
            grown.append(
                _Partial(
                    partial.weight * missed,
                    partial.options,
                    partial.used_peaks,
                    partial.assigned_tracks,
                )
            )
            for option in track_options:
                if partial.used_peaks >> option.peak & 1:
                    continue
                if any(partial.assigned_tracks >> other & 1 for other in option.tracks):
                    continue
                weight = partial.weight * option.weight
                for earlier in partial.options:
                    weight *= _resolved(earlier, option, merge_probabilities)
                assigned_tracks = partial.assigned_tracks
                for other in option.tracks:
                    assigned_tracks |= 1 << other
                grown.append(
                    _Partial(
                        weight,
                        (*partial.options, option),
                        partial.used_peaks | 1 << option.peak,
                        assigned_tracks,
                    )
                )
        ahead = prod(max_factor[track + 1 :])
        partials = [partial for partial in grown if partial.weight * ahead >= min_weight]
        if len(partials) > settings.max_hypotheses:
            partials.sort(key=lambda partial: -partial.weight)
            del partials[settings.max_hypotheses :]
        if len(partials) < len(grown):
            lost = sum(p.weight for p in grown) - sum(p.weight for p in partials)
            pruned_weight += max(lost, 0.0) * ahead
    best_partials: dict[tuple[int, tuple[tuple[int, int], ...]], _Partial] = {}
    for partial in partials:
        used = tuple(sorted((option.peak, len(option.tracks)) for option in partial.options))
        key = (partial.assigned_tracks, used)
        if key not in best_partials or partial.weight > best_partials[key].weight:
            best_partials[key] = partial
    total = sum(partial.weight for partial in best_partials.values())
    probabilities: list[dict[tuple[int, tuple[int, ...]], float]] = [{} for _ in cluster_tracks]
    for partial in best_partials.values():
        for option in partial.options:
            for track in option.tracks:
                assignment = (option.peak, option.tracks)
                probabilities[track][assignment] = (
                    probabilities[track].get(assignment, 0.0) + partial.weight / total
                )
    marginals = [
        [
            _marginals(track, peaks[peak], tracks, probability, cluster_tracks)
            for (peak, tracks), probability in sorted(track_probabilities.items())
        ]
        for track, track_probabilities in enumerate(probabilities)
    ]
    return marginals, pruned_weight / total


def _greedy(options: list[list[_Option]], missed: float) -> float:
    """Return the weight of one good joint hypothesis: each track in turn has its best peak."""
    weight, used_peaks = 1.0, 0
    for track_options in options:
        free = [
            option
            for option in track_options
            if len(option.tracks) == 1 and not used_peaks >> option.peak & 1
        ]
        best = max(free, key=lambda option: option.weight, default=None)
        if best is None or best.weight < missed:
            weight *= missed
        else:
            weight *= best.weight
            used_peaks |= 1 << best.peak
    return weight


def _options(
    track: int,
    cluster_tracks: list[ClusterTrack],
    peaks: list[Peak],
    merge_probabilities: dict[tuple[int, int], float],
    settings: TrackerSettings,
) -> list[_Option]:
    """Return how this track may be read, alone or with a later one; weights to ``missed``."""
    gain = settings.detection_probability / settings.clutter_density_per_px
    limit = settings.gate_sigma**2
    cluster_track = cluster_tracks[track]
    options = []
    for peak, (_, position, variance) in enumerate(peaks):
        total = cluster_track.variance_px2 + variance
        off = (position - cluster_track.reading_px) ** 2 / total
        if off <= limit:
            options.append(_Option((track,), peak, gain * _density(off, total)))
        for other_track in range(track + 1, len(cluster_tracks)):
            probability = merge_probabilities[track, other_track]
            if probability < MIN_MERGE_PROBABILITY:
                continue
            other = cluster_tracks[other_track]
            shared = variance + _share_variance(cluster_track, other)
            total = 0.25 * (cluster_track.variance_px2 + other.variance_px2) + shared
            off = (position - 0.5 * (cluster_track.reading_px + other.reading_px)) ** 2 / total
            if off <= limit:
                weight = settings.detection_probability * gain * probability * _density(off, total)
                options.append(_Option((track, other_track), peak, weight))
    return options


def _resolved(
    one: _Option, two: _Option, merge_probabilities: dict[tuple[int, int], float]
) -> float:
    """Return the probability that the tracks of two peaks were not found as one."""
    if len(one.tracks) > 1 or len(two.tracks) > 1:
        return 1.0
    pair = (one.tracks[0], two.tracks[0])
    return 1.0 - merge_probabilities[min(pair), max(pair)]


def _share_variance(one: ClusterTrack, two: ClusterTrack) -> float:
    """Return the variance of a shared peak about the middle of its two markers [px^2]."""
    apart = (one.reading_px - two.reading_px) ** 2
    return SHARE_FRACTION_VARIANCE * (apart + one.variance_px2 + two.variance_px2)


def _marginals(
    track: int,
    peak: Peak,
    tracks: tuple[int, ...],
    probability: float,
    cluster_tracks: list[ClusterTrack],
) -> Marginals:
    index, position, variance = peak
    cluster_track = cluster_tracks[track]
    if len(tracks) == 1:
        return Marginals(
            index, probability, position - cluster_track.reading_px, variance, merged=False
        )
    other = cluster_tracks[tracks[0] if tracks[1] == track else tracks[1]]
    # position = own / 2 + other / 2 + error: solved for the own reading.
    noise = 4.0 * (variance + _share_variance(cluster_track, other)) + other.variance_px2
    difference = 2.0 * position - other.reading_px - cluster_track.reading_px
    return Marginals(index, probability, difference, noise, merged=True)


def _density(off_squared: float, variance: float) -> float:
    return exp(-0.5 * off_squared) / sqrt(2.0 * pi * variance)


def split_clusters(
    cluster_tracks: list[ClusterTrack], peaks: list[Peak], settings: TrackerSettings
) -> Iterator[tuple[list[int], list[Peak]]]:
    """Yield the members of each cluster, in order, and its peaks.

    Tracks are in one cluster when a peak lies in the gates of both, or when they lie so near to
    one another that they may share one, directly or through others.

    Args:
        cluster_tracks: predicted readings of one sensor.
        peaks: usable peaks of that sensor.
        settings: gate and resolution.

    Yields:
        Ascending indices into ``cluster_tracks``, and the peaks that may be theirs.
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
        centre, half_width = cluster_tracks[member].reading_px, reach(member) + margin
        if not groups or centre - half_width > end + 2.0 * merge:
            groups.append([])
            end = -float("inf")
        groups[-1].append(member)
        end = max(end, centre + half_width)
    for group in groups:
        low = min(cluster_tracks[m].reading_px - reach(m) for m in group) - margin - merge
        high = max(cluster_tracks[m].reading_px + reach(m) for m in group) + margin + merge
        yield sorted(group), [peak for peak in peaks if low <= peak[1] <= high]
