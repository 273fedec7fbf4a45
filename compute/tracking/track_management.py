"""Track management: confirmation, matching of lost tracks, expiry."""

from math import log

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.reconstruction.triangulation import chi2_limit, squared_distances
from compute.tracking.motion_model import (
    ImmStates,
    MotionModels,
    combine_modes,
    position_spreads,
)
from compute.tracking.settings import TrackerSettings
from compute.tracking.tracks import Tracks

Array = NDArray[np.float64]

REACQUISITION_SIGNIFICANCE = 1e-4
"""Probability that a lost marker which moved as predicted is not recognised."""
INDISTINGUISHABLE_SIGNIFICANCE = 0.01
"""Significance of a difference in position and velocity that tells two tracks apart."""
MIN_SUPPORTED_HITS = 2
"""Exposures in which MIN_SUPPORT_SENSORS must have seen a new track."""
MIN_SUPPORTED_HITS_AMBIGUOUS = 10
"""The same, where other points explained its first peaks as well."""
MAX_HIT_FACTOR = 5
"""A tentative track ends after this multiple of ``confirm_hits`` if it is not confirmed."""
UNSUPPORTED_COAST_FACTOR = 0.2
"""Fraction of ``coast_s`` for which a track that may be a ghost is kept."""
SWAP_RESOLUTION_FACTOR = 6.0
"""Tracks with readings nearer than this multiple of ``resolution_px`` may exchange peaks."""
_SWAP_MIN_SENSORS = 2
PROBATION_EXPOSURES = 20
"""Exposures with support that a track initiated among many peaks needs after confirmation."""
_MOTION = 6


def select_confirmed(tracks: Tracks, settings: TrackerSettings) -> NDArray[np.intp]:
    """Return the rows of tentative tracks that are to be confirmed.

    The log likelihood ratio of a marker to false peaks is a sequential test (A. Wald, Sequential
    Analysis, 1947). Three planes meet at ghosts too, and go on doing so: a track that no fourth
    sensor sees is not confirmed, where there is a fourth sensor and more than one marker.

    Args:
        tracks: T tracks.
        settings: number of exposures and significance of the confirmation.
    """
    enough = log((1.0 - settings.false_track_probability) / settings.false_track_probability)
    good = ~tracks.confirmed & (tracks.hits >= settings.confirm_hits)
    good &= tracks.log_likelihood_ratio >= enough
    good &= tracks.supported_hits >= np.where(
        tracks.ambiguous_identity, MIN_SUPPORTED_HITS_AMBIGUOUS, MIN_SUPPORTED_HITS
    )
    return np.flatnonzero(good)


def possibly_swapped(
    reading_px: Array,
    unsupported: NDArray[np.bool_],
    confirmed: NDArray[np.bool_],
    resolution_px: float,
) -> NDArray[np.bool_]:
    """Return which of T tracks may be swapped: unsupported ones, and confirmed ones near them.

    Two that have passed each other may each have a peak of the other, while only one of them lacks
    a sensor for it.

    Args:
        reading_px: predicted, shape (T, S).
        unsupported: shape (T,).
        confirmed: shape (T,).
        resolution_px: the merging distance.
    """
    with np.errstate(invalid="ignore"):
        near = (
            np.abs(reading_px[:, None] - reading_px[unsupported][None])
            <= SWAP_RESOLUTION_FACTOR * resolution_px
        )
    beside: NDArray[np.bool_] = (near.sum(axis=2) >= _SWAP_MIN_SENSORS).any(axis=1)
    return unsupported | (beside & confirmed)


def find_replaced_track(
    peaks: NDArray[np.int32], row: int, doubted: NDArray[np.intp]
) -> int | None:
    """Return the uncertain track that rests on peaks of a new marker; None: none.

    Args:
        peaks: what each saw now, shape (T, S).
        row: the new marker's; four sensors have seen it.
        doubted: rows of tracks that may be ghosts.
    """
    unsupported = doubted[doubted != row]
    if len(unsupported) == 0:
        return None
    same = ((peaks[unsupported] == peaks[row]) & (peaks[row] >= 0)).sum(axis=1)
    best = int(same.argmax())
    return int(unsupported[best]) if same[best] >= 2 else None


def match_lost_track(
    motion: MotionModels, tracks: Tracks, row: int, lost: NDArray[np.intp]
) -> tuple[int, bool] | None:
    """Match a new marker to a lost track, and return whether that is ambiguous; None: no match.

    The one that moved there most likely, by position and velocity; with the same strobed marker the
    one that it is anyway.

    Args:
        motion: M models.
        tracks: all, those in question at the same time.
        row: the new marker's.
        lost: rows of confirmed tracks that are not seen.
    """
    marker = int(tracks.marker[row])
    same = [int(one) for one in lost if marker >= 0 and tracks.marker[one] == marker]
    if same:
        return same[0], False
    free = [int(one) for one in lost if marker < 0 or tracks.marker[one] < 0]
    if not free:
        return None
    both = combine_modes(motion, tracks.states.rows(np.array([row, *free])))
    mean, covariance = both.mean[:, :_MOTION], both.covariance[:, :_MOTION, :_MOTION]
    total = covariance[1:] + covariance[0]
    squared = squared_distances(mean[1:] - mean[0], total)
    near = np.flatnonzero(squared <= chi2_limit(_MOTION, REACQUISITION_SIGNIFICANCE))
    if len(near) == 0:
        return None
    cost = squared[near] + np.linalg.slogdet(total[near])[1]
    best = int(near[np.argmin(cost)])
    return free[best], len(near) > 1


def exclude_prior_duplicates(
    motion: MotionModels, tracks: Tracks, prior: ImmStates, position_mm: Array
) -> NDArray[np.intp]:
    """Return the rows of tracks that are kept when prior tracks are added.

    Args:
        motion: M models.
        tracks: all, at the time of the prior.
        prior: states of N markers.
        position_mm: of these, shape (N, 3).

    Raises:
        InvalidParameter: a prior marker may be one that is tracked.
    """
    keep = np.ones(len(tracks), dtype=np.bool_)
    tracked, other = combine_modes(motion, tracks.states), combine_modes(motion, prior)
    for marker, (mean, covariance) in enumerate(zip(other.mean, other.covariance, strict=True)):
        off = tracked.mean[:, :_MOTION] - mean[:_MOTION]
        total = tracked.covariance[:, :_MOTION, :_MOTION] + covariance[:_MOTION, :_MOTION]
        limit = chi2_limit(_MOTION, INDISTINGUISHABLE_SIGNIFICANCE)
        same = squared_distances(off, total) <= limit
        for row in np.flatnonzero(same & tracks.confirmed)[:1]:
            raise InvalidParameter(
                f"marker {marker} at {position_mm[marker].tolist()} mm may be track "
                f"{tracks.identity[row]} at {tracked.mean[row, :3].round(3).tolist()} mm; give "
                "only markers that are not tracked"
            )
        keep &= ~same
    return np.flatnonzero(keep)


def indistinguishable_tracks(
    motion: MotionModels, tracks: Tracks, rows: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return those rows whose position and velocity agree with another track's.

    Two tracks that meet go on as two, each with its own velocity; where even that agrees within
    its covariance, their identities may have been exchanged.

    Args:
        motion: M motion models.
        tracks: T tracks.
        rows: indices of the tracks to compare, shape (N,).
    """
    if len(rows) < 2:
        return np.empty(0, dtype=np.intp)
    position_mm, spread_mm = position_spreads(states := tracks.states.rows(rows))
    limit = chi2_limit(_MOTION, INDISTINGUISHABLE_SIGNIFICANCE)
    apart = np.sqrt(((position_mm[:, None] - position_mm[None]) ** 2).sum(axis=2))
    close = apart <= np.sqrt(limit) * (spread_mm[:, None] + spread_mm[None])
    close &= rows[:, None] < rows  # each pair once
    if not close.any():
        return np.empty(0, dtype=np.intp)
    combined = combine_modes(motion, states)
    indistinguishable: set[int] = set()
    for one, two in np.argwhere(close):
        # What the calibration's error does to both alike does not part them.
        bias, cross = tracks.bias[rows[one]], combined.bias_cross_covariance
        total = combined.covariance[one] + combined.covariance[two]
        if bias.any():
            common = cross[one] @ np.linalg.pinv(bias, hermitian=True) @ cross[two].T
            total = total - common - common.T
        total = total[:_MOTION, :_MOTION]
        off = combined.mean[one, :_MOTION] - combined.mean[two, :_MOTION]
        if off @ np.linalg.solve(total, off) <= limit:
            indistinguishable |= {int(one), int(two)}
    return rows[sorted(indistinguishable)]


def expired(tracks: Tracks, settings: TrackerSettings, time_ns: int) -> NDArray[np.bool_]:
    """Return which tracks end, shape (T,).

    Tentative ones that were not confirmed in time, and confirmed ones that were not seen, or not
    supported by enough sensors, for too long.

    Args:
        tracks: T tracks.
        settings: limits of confirmation and coasting.
        time_ns: time of the exposure [ns].
    """
    unsupported = tracks.may_be_ghosts
    unseen_ns, coast_ns = time_ns - tracks.last_detection_ns, round(settings.coast_s * 1e9)
    if tracks.confirmed.all() and not unsupported.any():
        return unseen_ns > coast_ns
    # A lost track that may be a ghost is not extrapolated for long.
    unseen = unseen_ns > np.where(
        unsupported & tracks.confirmed, UNSUPPORTED_COAST_FACTOR * coast_ns, coast_ns
    )
    failed_confirmation = tracks.misses > np.where(tracks.hits > 0, settings.confirm_misses, 0)
    failed_confirmation |= tracks.hits >= MAX_HIT_FACTOR * settings.confirm_hits
    # One of many that came up together may be a ghost even so.
    ghost = tracks.confirmed & (tracks.remaining_probation > 0) & unsupported
    return unseen | ghost | (~tracks.confirmed & failed_confirmation)
