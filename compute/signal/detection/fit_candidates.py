"""Candidates for the fit from detections: for lines that are too faint for a threshold."""

from math import log, sqrt

import numpy as np

from compute.errors import InvalidParameter
from compute.signal.detection.detection_batch import DetectionBatch
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakBatch, PeakFlag


def fit_candidates(
    detections: DetectionBatch, settings: FitSettings, width_px: float | None = None
) -> PeakBatch:
    """Return detections as the candidates that ``fit_lines`` takes in place of its own search.

    The single highest pixel of a faint wide line drowns in noise that the matched filter averages;
    from where the filter answers, the fit goes on as from any candidate. A position is given as
    certain to a pixel, and no more: what the fit then leaves UNFITTED is a whole pixel, with a
    standard deviation of 1 px, and no centre of gravity.

    Args:
        detections: of lines; of each line the ``settings.search.max_peaks`` of the highest answer
            are kept.
        settings: of the fit that they are for.
        width_px: deviation of the line that the filter was made for; None: ``settings.width_px``.

    Raises:
        InvalidParameter: a width that is not positive.
    """
    width = settings.width_px if width_px is None else width_px
    if not 0.0 < width < np.inf:
        raise InvalidParameter(f"width_px is {width}; it must be positive", width_px=width)
    room = settings.search.max_peaks
    lines, places = detections.position_px.shape
    there = np.arange(places) < detections.count[:, None]
    # Rank by answer, the first of equals first; then back into the order of places.
    answer = np.where(there, detections.response_sigma, -np.inf)
    rank = np.argsort(np.argsort(-answer, axis=1, kind="stable"), axis=1, kind="stable")
    kept = there & (rank < room)
    line, column = np.nonzero(kept)
    place = (np.cumsum(kept, axis=1) - 1)[line, column]
    at_threshold = 2.0 * sqrt(-2.0 * log(settings.search.threshold_fraction))
    found = PeakBatch.empty(lines, room)
    found.count[:] = kept.sum(axis=1)
    found.position_px[line, place] = detections.position_px[line, column]
    found.sigma_px[line, place] = 1.0
    found.amplitude[line, place] = detections.amplitude[line, column]
    found.width_px[line, place] = at_threshold * width
    # What the filter calls merged is decided by the fit.
    flags = detections.flags[line, column] & ~int(PeakFlag.MERGED)
    lost = there.sum(axis=1) > room
    found.flags[line, place] = np.where(lost[line], flags | PeakFlag.TRUNCATED, flags)
    return found
