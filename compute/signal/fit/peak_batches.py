"""Fitted peaks as a batch: flags, order, room, and covariances of neighbours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.signal.array_rows import ArrayRows
from compute.signal.fit.model_order import SelectedFits
from compute.signal.fit.window_model import Array
from compute.signal.peaks import MAX_JOINT_PEAKS, PeakBatch, PeakFlag, number_within_scan

_CLIPPED_WIDTHS = 2.0


@dataclass(frozen=True, eq=False)
class FlatPeaks(ArrayRows):
    """Peaks of many scans in no order.

    Args:
        scan: shape (M,).
        group: numbers of their groups, shape (M,).
        within: their place within the group, shape (M,).
        position_px: shape (M,).
        sigma_px: shape (M,).
        amplitude: shape (M,).
        width_px: shape (M,).
        flags: shape (M,).
        reduced_chi2: shape (M,).
        covariance_px2: with all of the group, shape (M, MAX_JOINT_PEAKS).
    """

    scan: NDArray[np.int64]
    group: NDArray[np.int64]
    within: NDArray[np.int64]
    position_px: Array
    sigma_px: Array
    amplitude: Array
    width_px: Array
    flags: NDArray[np.int64]
    reduced_chi2: Array
    covariance_px2: Array


def collect_fitted_peaks(selected: SelectedFits, candidates: PeakBatch, pixels: int) -> FlatPeaks:
    """Return the peaks of the groups whose fits were good.

    Args:
        selected: fits of groups of equal size; the good ones count.
        candidates: of all scans.
        pixels: pixels of a scan.
    """
    selected = selected[selected.solution.good]
    model, groups, windows = selected.model, selected.groups, selected.windows
    solution, settings = selected.solution, model.settings
    position_px = solution.parameters[:, model.position]
    order = np.argsort(position_px, axis=1, kind="stable")
    position = np.take_along_axis(position_px, order, axis=1)
    light = np.take_along_axis(solution.parameters[:, model.light], order, axis=1)
    factor = settings.variance_factor(solution.chi2, solution.dof)
    covariance = solution.covariance[:, model.position, model.position] * factor[:, None, None]
    covariance = np.take_along_axis(covariance, order[:, :, None], axis=1)
    covariance = np.take_along_axis(covariance, order[:, None, :], axis=2)
    width = np.exp(solution.parameters[:, -1:])
    share = model.central_pixel_fraction(width, windows.sensor[:, None], position)

    flags = np.zeros(position.shape, np.int64)
    if model.peaks > 1:
        flags |= PeakFlag.JOINT
    limit = settings.chi2_limits()[solution.dof]
    in_window = windows.last_px - windows.first_px + 1
    flags |= PeakFlag.POOR_FIT * (solution.chi2 > limit)[:, None]
    masked = windows.masked.sum(axis=1)
    flags |= PeakFlag.MASKED_PIXELS * (masked > 0)[:, None]
    flags |= PeakFlag.SATURATED * (windows.count + masked < in_window)[:, None]
    reach = _CLIPPED_WIDTHS * width
    clipped = (position - reach < -0.5) | (position + reach > pixels - 0.5)
    flags |= PeakFlag.CLIPPED * clipped
    flags[:, 0] |= PeakFlag.MERGED * groups.split_before
    flags[:, -1] |= PeakFlag.MERGED * groups.split_after
    if len(groups) and int(groups.count[0]) == model.peaks:
        flags |= (
            candidates.flags[groups.scan[:, None], groups.candidate_indices()] & PeakFlag.MERGED
        )

    count = position.shape[1]
    padded_covariance = np.zeros((len(groups), count, MAX_JOINT_PEAKS))
    padded_covariance[:, :, :count] = covariance
    f = settings.search.threshold_fraction
    full_width = np.broadcast_to(2.0 * np.sqrt(-2.0 * np.log(f)) * width, position.shape)
    reduced = (solution.chi2 / solution.dof)[:, None]
    return FlatPeaks(
        np.repeat(groups.scan, count),
        np.repeat(groups.number, count),
        np.tile(np.arange(count), len(groups)),
        position.ravel(),
        np.sqrt(np.einsum("nkk->nk", covariance)).ravel(),
        (light * share).ravel(),
        full_width.ravel(),
        flags.ravel(),
        np.broadcast_to(reduced, position.shape).ravel(),
        padded_covariance.reshape(-1, MAX_JOINT_PEAKS),
    )


def collect_unfitted_peaks(selected: SelectedFits, candidates: PeakBatch) -> FlatPeaks:
    """Return the candidates of the groups whose fits failed.

    Args:
        selected: fits of groups of equal size; the failed ones count.
        candidates: of all scans.
    """
    groups = selected.groups[~selected.solution.good]
    member = groups.candidate_indices()
    count = member.shape[1]
    at = (np.repeat(groups.scan, count), member.ravel())
    flags = candidates.flags[at].reshape(member.shape).astype(np.int64) | PeakFlag.UNFITTED
    flags[:, :1] |= PeakFlag.MERGED * groups.split_before[:, None]
    flags[:, -1:] |= PeakFlag.MERGED * groups.split_after[:, None]
    return FlatPeaks(
        at[0],
        np.repeat(groups.number, count),
        np.tile(np.arange(count), len(groups)),
        candidates.position_px[at],
        candidates.sigma_px[at].astype(np.float64),
        candidates.amplitude[at].astype(np.float64),
        candidates.width_px[at].astype(np.float64),
        flags.ravel(),
        np.full(member.size, np.nan),
        np.zeros((member.size, MAX_JOINT_PEAKS)),
    )


def to_peak_batch(
    peaks: FlatPeaks, scans: int, room: int, truncated: NDArray[np.bool_]
) -> PeakBatch:
    """Order peaks by scan and position; keep the brightest where there is no room for all.

    Args:
        peaks: of all scans.
        scans: L.
        room: K.
        truncated: scans that have lost peaks already, shape (L,).
    """
    batch = PeakBatch.empty(scans, room)
    by_light = np.lexsort((peaks.position_px, -peaks.amplitude, peaks.scan))
    rank = number_within_scan(peaks.scan[by_light])
    truncated = truncated.copy()
    truncated[peaks.scan[by_light[rank >= room]]] = True
    peaks = peaks[by_light[rank < room]]
    # A group's peaks lie within its window, and windows do not overlap.
    peaks = peaks[np.lexsort((peaks.within, peaks.position_px, peaks.scan))]
    slot = number_within_scan(peaks.scan)
    at = (peaks.scan, slot)
    batch.count[:] = np.bincount(peaks.scan, minlength=scans)
    for name in ("position_px", "sigma_px", "amplitude", "width_px", "reduced_chi2"):
        getattr(batch, name)[at] = getattr(peaks, name)
    batch.flags[at] = peaks.flags | PeakFlag.TRUNCATED * truncated[peaks.scan]
    row = np.arange(len(slot))
    for ahead in range(1, MAX_JOINT_PEAKS):
        here = row[: max(len(row) - ahead, 0)]
        here = here[peaks.group[here] == peaks.group[here + ahead]]
        covariance = peaks.covariance_px2[here, peaks.within[here + ahead]]
        batch.covariance_px2[peaks.scan[here], slot[here], ahead - 1] = covariance
    return batch
