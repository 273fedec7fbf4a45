"""Joint hypotheses: beside plain enumeration, shared peaks, and bounds beyond it."""

from itertools import product
from math import exp, pi, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.tracking.joint_events import (
    ClusterTrack,
    event_marginals,
    merge_probability,
    split_clusters,
)
from compute.tracking.settings import TrackerSettings

SETTINGS = TrackerSettings(resolution_px=1e-6)
"""Peaks that are never shared."""

Peak = tuple[int, float, float]


def enumerated(
    cluster_tracks: list[ClusterTrack], peaks: list[Peak], assumed: TrackerSettings
) -> list[dict[int, float]]:
    """Chances of each track's peaks by the definition: the best of each set of tracks, peaks."""
    best: dict[tuple[tuple[bool, ...], tuple[int, ...]], tuple[float, tuple[int, ...]]] = {}
    for choice in product(range(-1, len(peaks)), repeat=len(cluster_tracks)):
        used = [peak for peak in choice if peak >= 0]
        if len(used) != len(set(used)):
            continue
        weight = 1.0
        for track, peak in zip(cluster_tracks, choice, strict=True):
            if peak < 0:
                weight *= 1.0 - assumed.detection_probability
                continue
            total = track.variance_px2 + peaks[peak][2]
            off = (peaks[peak][1] - track.reading_px) ** 2 / total
            inside = off <= assumed.gate_sigma**2
            density = exp(-0.5 * off) / sqrt(2.0 * pi * total) if inside else 0.0
            weight *= assumed.detection_probability / assumed.clutter_density_per_px * density
        key = (tuple(peak >= 0 for peak in choice), tuple(sorted(used)))
        if weight > best.get(key, (0.0, ()))[0]:
            best[key] = (weight, choice)
    total = sum(weight for weight, _ in best.values())
    chances: list[dict[int, float]] = [{} for _ in cluster_tracks]
    for weight, choice in best.values():
        for track, peak in enumerate(choice):
            if peak >= 0:
                own = chances[track]
                own[peaks[peak][0]] = own.get(peaks[peak][0], 0.0) + weight / total
    return chances


@given(
    readings=st.lists(st.floats(0.0, 6.0), min_size=1, max_size=4, unique=True),
    positions=st.lists(st.floats(-1.0, 7.0), min_size=0, max_size=4, unique=True),
)
@settings(deadline=None)
def test_chances_are_those_of_plain_enumeration(
    readings: list[float], positions: list[float]
) -> None:
    cluster_tracks = [ClusterTrack(reading, 0.2 + 0.1 * n) for n, reading in enumerate(readings)]
    peaks = [(7 + n, position, 0.01) for n, position in enumerate(positions)]
    found, _ = event_marginals(cluster_tracks, peaks, SETTINGS)
    for own, right in zip(found, enumerated(cluster_tracks, peaks, SETTINGS), strict=True):
        chances = {claim.peak: claim.probability for claim in own}
        for peak in chances.keys() | right.keys():
            assert chances.get(peak, 0.0) == pytest.approx(right.get(peak, 0.0), abs=1e-4)


def test_two_tracks_side_by_side_keep_their_peaks() -> None:
    """Averaging over exchanged peaks would draw both to the middle: coalescence."""
    cluster_tracks = [ClusterTrack(10.0, 1.0), ClusterTrack(10.6, 1.0)]
    found, _ = event_marginals(cluster_tracks, [(0, 10.0, 0.01), (1, 10.6, 0.01)], SETTINGS)
    shift = [sum(claim.probability * claim.difference_px for claim in own) for own in found]
    assert max(abs(value) for value in shift) < 0.1


def test_a_single_peak_between_two_tracks_is_shared() -> None:
    assumed = TrackerSettings(resolution_px=4.0)
    cluster_tracks = [ClusterTrack(10.0, 0.01), ClusterTrack(12.0, 0.01)]
    found, _ = event_marginals(cluster_tracks, [(3, 11.2, 0.0025)], assumed)
    for own, reading in zip(found, (10.0, 12.0), strict=True):
        claim = max(own, key=lambda one: one.probability)
        assert claim.merged
        assert claim.probability > 0.95
        # Where it says the track to be is within what it says of its own error.
        assert abs(claim.difference_px) < 3.0 * sqrt(claim.variance_px2)
        assert reading + claim.difference_px == pytest.approx(2 * 11.2 - (22.0 - reading))


def test_variance_of_a_shared_peak_covers_every_share() -> None:
    """Over all shares of the two markers the error is as large as is claimed, on the average."""
    assumed = TrackerSettings(resolution_px=4.0)
    rng = np.random.default_rng(4)
    squares, claimed = [], []
    for _ in range(4000):
        true = np.array([10.0, 12.0])
        predicted = true + 0.1 * rng.standard_normal(2)
        share = rng.uniform()
        peak = share * true[0] + (1.0 - share) * true[1] + 0.05 * rng.standard_normal()
        cluster_tracks = [ClusterTrack(float(value), 0.01) for value in predicted]
        found, _ = event_marginals(cluster_tracks, [(0, float(peak), 0.0025)], assumed)
        for claim in found[0]:
            if claim.merged:
                squares.append((predicted[0] + claim.difference_px - true[0]) ** 2)
                claimed.append(claim.variance_px2)
    assert len(squares) > 3000
    # Peaks at either end are taken as a single marker's, so that the rest spreads a little less.
    assert 0.6 < np.mean(squares) / np.mean(claimed) < 1.05


@given(apart=st.floats(0.0, 20.0), variance=st.floats(0.0, 10.0))
def test_merged_chance_is_an_average(apart: float, variance: float) -> None:
    nodes, weights = np.polynomial.hermite_e.hermegauss(200)
    distance = apart + sqrt(variance) * nodes
    mean = float(weights @ np.exp(-np.log(2.0) * (distance / 4.0) ** 2) / weights.sum())
    assert merge_probability(apart, variance, 4.0) == pytest.approx(mean, abs=1e-6)


def test_what_is_given_up_is_bounded() -> None:
    """With few hypotheses kept, chances are off by no more than the stated share."""
    rng = np.random.default_rng(1)
    cluster_tracks = [ClusterTrack(float(n) * 0.8, 0.3) for n in range(7)]
    peaks = [(n, float(n) * 0.8 + 0.3 * rng.standard_normal(), 0.01) for n in range(7)]
    exact, none = event_marginals(
        cluster_tracks, peaks, TrackerSettings(resolution_px=1e-6, max_hypotheses=10**6)
    )
    assert none < 1e-3
    for most in (20, 100, 1000):
        few, pruned_weight = event_marginals(
            cluster_tracks, peaks, TrackerSettings(resolution_px=1e-6, max_hypotheses=most)
        )
        assert pruned_weight > 0.0
        for own, right in zip(few, exact, strict=True):
            chances = {claim.peak: claim.probability for claim in own}
            for claim in right:
                assert abs(chances.get(claim.peak, 0.0) - claim.probability) <= pruned_weight + 1e-9


@given(
    readings=st.lists(st.floats(0.0, 300.0), min_size=1, max_size=12),
    positions=st.lists(st.floats(0.0, 300.0), max_size=15),
)
@settings(deadline=None)
def test_clusters_share_no_track_and_no_gated_peak(
    readings: list[float], positions: list[float]
) -> None:
    assumed = TrackerSettings()
    cluster_tracks = [ClusterTrack(reading, 0.5) for reading in readings]
    peaks = [(n, position, 0.01) for n, position in enumerate(positions)]
    owner: dict[int, int] = {}
    taken: dict[int, int] = {}
    for number, (members, own) in enumerate(split_clusters(cluster_tracks, peaks, assumed)):
        for member in members:
            assert member not in taken
            taken[member] = number
        for peak in own:
            assert owner.setdefault(peak[0], number) == number
    assert sorted(taken) == list(range(len(readings)))
    for member, reading in enumerate(readings):
        for index, position, variance in peaks:
            if abs(position - reading) <= assumed.gate_sigma * sqrt(0.5 + variance):
                assert owner[index] == taken[member]
