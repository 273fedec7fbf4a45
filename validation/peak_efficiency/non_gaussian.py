"""Non-Gaussian stripes from the optics, fitted as Gaussians and by their own shape."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.stripe_optics.stripe_profile import CELLS, Blur
from compute.optics.stripe_optics.traced_stripes import RaySampling, TracedStripes
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.peaks import MAX_JOINT_PEAKS, PeakFlag
from validation.aberrations.thesis_lens import FOCUSED_MM, StopPlace, stopped_lens
from validation.joint_position_bounds import joint_position_bounds
from validation.peak_efficiency.monte_carlo import match_true_peaks
from validation.skew_effect.traced_readings import FIELD_U, LONG_ROW
from validation.synthetic_scans import (
    AMBIENT,
    MIDDLE_PX,
    PIXELS,
    Array,
    expose,
    find,
    line_noise,
    nearest,
)

READ_NOISE: Final = 20.0
LIGHTS: Final = (1e4, 1e5)
AS_GAUSSIAN, ALLOWING, AS_MEASURED = "as a Gaussian", "allowing 5 %", "its own shape"
"""A Gaussian of any width; the same with an error of its shape; the line's shape."""
SHAPE_ERROR: Final = 0.05

_WAVELENGTH_NM: Final = 950.0
_HALF_PX: Final = 24  # the lines' tails are cut there
_RAYS: Final = RaySampling(257, max_rays=257)


@dataclass(frozen=True)
class Optics:
    """Where a line comes from: lens 3.4 with a slit, an LED at 1.5 m.

    Args:
        title: what it is.
        slit_mm: width of the slit.
        place: where the slit is.
        focus_mm: shift of the sensor from the paraxial image.
        emitter_mm: diameter of the LED.
        field: place in the field along the row, as a part of its end.
    """

    title: str
    slit_mm: float
    place: StopPlace
    focus_mm: float
    emitter_mm: float
    field: float


OPTICS: Final = (
    Optics("diffraction", 2.0, "8 mm in front", -0.75, 0.3, 0.0),
    Optics("LED of 6 mm", 2.0, "8 mm in front", -0.75, 6.0, 0.0),
    Optics("out of focus", 4.0, "8 mm in front", -1.0, 0.3, 0.0),
    Optics("coma", 2.0, "on the plane face", -0.5, 3.0, 0.5),
)


@dataclass(frozen=True, eq=False)
class OpticalLine:
    """A line on cells of 1/CELLS px, about its centre of gravity.

    Args:
        share: of the light, shape (C,); C is even.
        first_px: left edge of the first cell, from the centre of gravity.
        unit_px: the deviation of a Gaussian with the same middle half of the light.
        skewness: third standardised moment.
    """

    share: Array
    first_px: float
    unit_px: float
    skewness: float

    @property
    def shape(self) -> LineSpreadFunction:
        """The line's shape, with ``unit_px`` as the width."""
        return LineSpreadFunction.from_cells(
            self.share, self.first_px, 1.0 / CELLS, unit_px=self.unit_px
        )

    def electrons(self, light: float, cells: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return mean electrons (N, PIXELS) of lines moved by cells, and their positions (N,)."""
        start = (MIDDLE_PX - _HALF_PX) * CELLS
        fine = np.zeros((len(cells), PIXELS * CELLS))
        fine[
            np.arange(len(cells))[:, None], start + cells[:, None] + np.arange(len(self.share))
        ] = light * self.share
        position = (start + cells) / CELLS - 0.5 - self.first_px
        return fine.reshape(len(cells), PIXELS, CELLS).sum(axis=2), position


@cache
def optical_line(optics: Optics) -> OpticalLine:
    """Trace a line."""
    assembly = stopped_lens(optics.slit_mm, optics.place, optics.focus_mm)
    blur = Blur(_WAVELENGTH_NM, optics.emitter_mm)
    point = FOCUSED_MM * np.array([[optics.field * FIELD_U, 0.0, 1.0]])
    line = TracedStripes(assembly, LONG_ROW, blur, _RAYS).shapes(point)
    centre = round(float((line.centroid_px[0] - line.first_px[0] + 0.5) * CELLS))
    half = _HALF_PX * CELLS
    cells = np.pad(line.cell_sr[0], half)[centre : centre + 2 * half]
    share = cells / cells.sum()
    centres = (np.arange(2 * half) + 0.5) / CELLS
    gravity = float((share * centres).sum())
    away = centres - gravity
    variance = float((share * away**2).sum())
    below = np.concatenate([[0.0], np.cumsum(share)])
    low, high = np.interp([0.25, 0.75], below, np.arange(2 * half + 1) / CELLS)
    return OpticalLine(
        share,
        -gravity,
        float(high - low) / 1.34898,
        float((share * away**3).sum()) / variance**1.5,
    )


@dataclass(frozen=True)
class ShapeErrors:
    """How a line was fitted.

    Args:
        rms_px: errors about their mean, root mean square.
        offset_px: mean error: constant, as long as the shape is.
        by_phase_px: largest mean error, less that, at one of the 16 places within a pixel.
        nees: mean of the squared errors about their mean, in stated standard deviations.
        poor: share flagged POOR_FIT.
        peaks: mean number of peaks where up to MAX_JOINT_PEAKS may be seen; in one line of sixteen.
    """

    rms_px: float
    offset_px: float
    by_phase_px: float
    nees: float
    poor: float
    peaks: float


@dataclass(frozen=True)
class ShapeFigures:
    """A line's bound and errors by the way of fitting."""

    optics: Optics
    light: float
    bound_px: float
    errors: dict[str, ShapeErrors]


def shape_figures(optics: Optics, light: float, count: int, seed: int = 2) -> ShapeFigures:
    """Fit ``count`` exposures at each of the 16 places within a pixel."""
    rng = np.random.default_rng(seed)
    line = optical_line(optics)
    cells = np.repeat(np.arange(CELLS), count)
    mean, position = line.electrons(light, cells)
    lines = expose(mean, READ_NOISE, rng)
    noise = line_noise(READ_NOISE)
    own = FitSettings(width_px=line.unit_px, width_log_sigma=0.0, max_joint_peaks=1)
    gaussian = FitSettings(width_px=line.unit_px, width_log_sigma=np.inf, max_joint_peaks=1)
    ways = {
        AS_GAUSSIAN: (gaussian, LineSpreadFunction.gaussian()),
        ALLOWING: (replace(gaussian, shape_error=SHAPE_ERROR), LineSpreadFunction.gaussian()),
        AS_MEASURED: (own, line.shape),
    }
    bound = joint_position_bounds(
        position[::count, None], [light], AMBIENT, PIXELS, own, noise, line.shape
    ).mean()
    start = nearest(
        find(lines, own.search, READ_NOISE), position, line.unit_px, float(mean.max()), rng
    )
    errors = {}
    row = np.arange(len(position))
    for name, (settings, shape) in ways.items():
        found = fit_scans(lines, settings, noise, shape, start.peaks)
        joint = replace(settings, max_joint_peaks=MAX_JOINT_PEAKS)
        more = fit_scans(
            lines[::CELLS], joint, noise, shape, find(lines[::CELLS], own.search, READ_NOISE)
        )
        nearest_peak = match_true_peaks(found, position)
        error = found.position_px[row, nearest_peak] - position
        offset = float(error.mean())
        by_phase = error.reshape(CELLS, count).mean(axis=1) - offset
        errors[name] = ShapeErrors(
            float(np.sqrt(np.mean((error - offset) ** 2))),
            offset,
            float(np.abs(by_phase).max()),
            float(np.mean(((error - offset) / found.sigma_px[row, nearest_peak]) ** 2)),
            float(np.mean((found.flags[row, nearest_peak] & PeakFlag.POOR_FIT) != 0)),
            float(more.count.mean()),
        )
    return ShapeFigures(optics, light, float(np.sqrt(bound)), errors)
