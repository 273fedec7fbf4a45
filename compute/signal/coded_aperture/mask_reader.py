"""Readings of the shadows behind coded windows, at most one a scan."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.coded_aperture.shadow_fit import ShadowFitter, ShadowSettings
from compute.signal.coded_aperture.shadow_template import ShadowTemplate
from compute.signal.peaks import PeakBatch
from compute.signal.sensor_noise import SensorNoise


class MaskReader:
    """Reads the shadows of single markers on S sensors behind coded windows.

    Args:
        templates: one for each of the S sensors, or one for all.
        pixels: pixels of a scan.
        noise: noise of the S sensors, or of one for all; scan l of a batch is of sensor
            ``l % S``, S the larger of both numbers.
        settings: what counts as found, and what is fitted.

    Raises:
        InvalidParameter: numbers of templates and of sensors that do not agree, or a scan that
            is too short.
    """

    def __init__(
        self,
        templates: Sequence[ShadowTemplate],
        pixels: int,
        noise: SensorNoise,
        settings: ShadowSettings | None = None,
    ) -> None:
        sensors = max(len(templates), len(noise))
        if not (len(templates) in (1, sensors) and len(noise) in (1, sensors)):
            raise InvalidParameter(
                f"there are {len(templates)} templates and the noise of {len(noise)} sensors; "
                "give one, or one per sensor",
                templates=len(templates),
                sensors=len(noise),
            )
        self.pixels = pixels
        self._fitters = tuple(
            ShadowFitter(
                templates[sensor % len(templates)],
                pixels,
                noise[np.array([sensor % len(noise)])],
                settings,
            )
            for sensor in range(sensors)
        )

    def read(self, scans: NDArray[np.uint16]) -> PeakBatch:
        """Read scans of counts, uint16, shape (L, P), as a batch of one peak a scan (K = 1).

        Positions are readings, ``template.reading_px + shift``, which may lie beyond the scan's
        ends; widths are those of the lit patterns, as magnified.

        Raises:
            InvalidParameter: another type or shape.
        """
        batch = PeakBatch.empty(len(scans), 1)
        for sensor, fitter in enumerate(self._fitters):
            own = slice(sensor, None, len(self._fitters))
            fit = fitter.fit(scans[own])
            template = fitter.template
            batch.count[own] = fit.found
            batch.position_px[own, 0] = template.reading_px + fit.shift_px
            batch.sigma_px[own, 0] = fit.sigma_px
            batch.amplitude[own, 0] = fit.amplitude
            batch.width_px[own, 0] = template.lit_width_px * fit.scale
            batch.flags[own, 0] = fit.flags
            batch.reduced_chi2[own, 0] = fit.reduced_chi2
        return batch
