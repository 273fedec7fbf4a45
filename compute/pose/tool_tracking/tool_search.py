"""ToolSearch: acquisition of the lost tools of a tracker, exposure by exposure."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.acquisition.acquisition_simultaneous import acquire_simultaneous
from compute.pose.acquisition.acquisition_strobed import MarkerExposure, acquire_strobed
from compute.pose.filtering.association import MAX_EXCLUDED_NIS, ToolObservation, without_peaks
from compute.pose.rigid_body import PoseStatus
from compute.pose.settings import ToolTrackerSettings
from compute.pose.tool_tracking.tool_track import (
    ACQUISITION_CYCLES,
    COAST_CYCLES,
    CONSISTENCY_CYCLES,
    ExposureResiduals,
    ToolTrack,
    pack_mask,
)
from compute.reconstruction.point_batch import PointBatch

MIN_EXPOSURES: Final = 8
"""Smallest number of exposures kept for acquisition: enough for three markers and two sensors."""


class ToolSearch:
    """Searches for lost tools and begins their tracks.

    Args:
        model: the cameras.
        settings: limits and tolerances.
    """

    def __init__(self, model: MeasurementModel, settings: ToolTrackerSettings) -> None:
        self._model, self._settings = model, settings

    def strobed(
        self, tool: ToolTrack, time_ns: int, marker: int, measurements: Measurements, cycle_ns: int
    ) -> None:
        """Keep an exposure of a lost strobed tool; search for it when there are enough.

        Args:
            tool: the lost tool.
            time_ns: time of the exposure [ns].
            marker: index of the lit marker in the tool.
            measurements: peaks that may start a track.
            cycle_ns: period of the tool's strobe [ns]; 0: unknown.
        """
        backoff, markers = tool.backoff, len(tool.body)
        before = list(tool.exposures)[-markers:]
        if len(before) == markers and not any(one.any_reading for one in before):
            backoff.reset()  # all of its markers were hidden
        tool.exposures.append(MarkerExposure(time_ns, marker, *measurements.unambiguous_readings()))
        most = max(ACQUISITION_CYCLES * markers, MIN_EXPOSURES)
        window_ns = max(
            round(1e9 * self._settings.acquisition_window_s),
            round(ACQUISITION_CYCLES * COAST_CYCLES * cycle_ns),
        )
        while tool.exposures[0].time_ns < time_ns - window_ns or len(tool.exposures) > most:
            tool.exposures.popleft()
        tool.exposures_since_search += 1
        backoff.count_exposure()
        with_readings = [one for one in tool.exposures if one.any_reading]
        if not with_readings and tool.status is PoseStatus.OUT_OF_VIEW:
            return
        if not with_readings or not (backoff.is_waiting or tool.status is PoseStatus.INVALID):
            tool.status = PoseStatus.MISSING
            tool.reason = (
                f"{len({one.marker for one in with_readings})} of {markers} markers were seen in "
                f"the last {1e-6 * window_ns:.3g} ms"
            )
        # Wait for a cycle after a failure: the same exposures would fail again.
        if (
            tool.exposures_since_search < markers
            or not with_readings
            or with_readings[-1].time_ns != time_ns
        ):
            return
        readings = sum(int(np.isfinite(one.readings_px).sum()) for one in with_readings)
        if not backoff.due(time_ns, readings):
            return
        acquisition = acquire_strobed(
            self._model, tool.centred, with_readings, tool.common_errors, self._settings
        )
        if acquisition.searched:
            # A failure until it is confirmed. Too few readings may suffice with the next exposure.
            too_few = acquisition.state is None and not acquisition.inconsistent
            backoff.record_failure(time_ns, readings, 1 if too_few else markers)
        if acquisition.state is None:
            tool.exposures_since_search = (
                0 if acquisition.inconsistent else tool.exposures_since_search
            )
            tool.status = PoseStatus.INVALID if acquisition.inconsistent else PoseStatus.MISSING
            tool.reason = str(acquisition.reason)
            return
        tool.begin(acquisition.state, time_ns, exposures_to_confirm=markers)
        tool.exposures.clear()
        used = np.zeros((markers, len(self._model)), dtype=np.bool_)
        sigma = np.full(used.shape, np.nan)
        for one in with_readings:
            used[one.marker] = np.isfinite(one.readings_px)
            sigma[one.marker] = np.where(used[one.marker], one.sigma_px, np.nan)
        tool.keep_sigma(sigma)
        tool.record_used(pack_mask(used), CONSISTENCY_CYCLES * markers)
        update = acquisition.nis, acquisition.readings
        tool.recent_updates.append((*update, pack_mask(used)))
        tool.recent_residuals.append(ExposureResiduals(*update))

    def simultaneous(
        self,
        lost: Sequence[ToolTrack],
        time_ns: int,
        measurements: Measurements,
        tracked: Sequence[ToolObservation],
        points: PointBatch | None,
    ) -> None:
        """Search for lost tools whose markers are lit together, among the points of a frame.

        Args:
            lost: the tools that are lost, or have no readings in this frame.
            time_ns: time of the frame [ns].
            measurements: peaks that may start a track.
            tracked: the other tools in this frame.
            points: reconstructed points of the frame; None: none.
        """
        acquisitions = acquire_simultaneous(
            self._model,
            [tool.body for tool in lost],
            [tool.common_errors for tool in lost],
            time_ns,
            without_peaks(measurements, [one.peaks for one in tracked]),
            tracked,
            points,
            self._settings,
        )
        for tool, one in zip(lost, acquisitions, strict=True):
            if one.state is not None:
                tool.begin(one.state, time_ns, exposures_to_confirm=0)
                tool.keep_sigma(one.sigma_px)
                tool.record_used(pack_mask(one.sensors), CONSISTENCY_CYCLES)
                readings, excluded = int(one.sensors.sum()), int(one.excluded.sum())
                tool.recent_updates.append((one.nis, readings, pack_mask(one.sensors)))
                square = one.nis + MAX_EXCLUDED_NIS * excluded
                tool.recent_residuals.append(
                    ExposureResiduals(
                        square, readings + excluded, one.excluded if excluded else None
                    )
                )
            elif tool.state is None and (
                one.point_count or tool.status is not PoseStatus.OUT_OF_VIEW
            ):
                tool.status, tool.reason = one.status, one.reason
