"""Quality of stripes by stop and focus: width, skewness, light, bound, distortion."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from compute.camera.field_distortion import Term
from compute.errors import NoConvergence
from compute.optics.stripe_optics.stripe_profile import CELLS, Blur, StripeProfiles
from compute.optics.stripe_optics.traced_stripes import RaySampling, TracedStripes
from compute.optics.tracing.assembly import Assembly, Lens, Stop
from compute.optics.tracing.surfaces import Aperture, Conic, Plane
from compute.planning.cramer_rao import PixelNoise, shifted_stripes
from compute.signal.cramer_rao import position_bound
from validation.aberrations.paraxial import paraxial_system
from validation.aberrations.seidel import Conjugates, seidel_sums
from validation.aberrations.thesis_lens import (
    FOCUSED_MM,
    INDEX,
    RADIUS_MM,
    THICKNESS_MM,
    WIDTH_MM,
    StopPlace,
    stopped_lens,
)
from validation.skew_effect.traced_readings import (
    FIELD_U,
    FIELD_V,
    LONG_ROW,
    field_points,
    fitted,
    traced_readings,
)

Array = NDArray[np.float64]

BLUR: Final = Blur(wavelength_nm=950.0, emitter_width_mm=0.3)
"""An infrared LED (section 3.4: LD275); the chip's size is assumed."""
ELECTRONS_PER_SR: Final = 1e12
"""Photoelectrons that the LED sends out in an exposure; assumed: some 20 000 in a line at 4 mm."""
READ_NOISE_ELECTRONS: Final = 50.0
BACKGROUND_ELECTRONS_PER_MM: Final = 250.0
"""Of ambient light in a pixel, by millimetre of the stop, which lets that light in too; assumed."""

FIELD_POSITIONS: Final[dict[str, tuple[float, float]]] = {
    "middle": (0.0, 0.0),
    "row's end": (0.93 * FIELD_U, 0.0),
    "corner": (0.93 * FIELD_U, FIELD_V),
}
"""Where in the field lines are looked at: x/z and y/z, at 1.5 m."""

NEAREST_MM: Final = -24.0
"""How far from the paraxial image the best focus is looked for: near the lens."""

# As fine as a search can be: within 0.003 px of 1025 rays in all widths here.
_RAYS: Final = RaySampling(257, max_rays=257)
_EXPOSURES: Final = 1024  # simulated at each of the 16 places within a pixel: errors to 0.6 %
_STEPS_MM: Final = (1.0, 0.5, 0.25)
_EXTENT: Final = 0.01  # of the peak: where a line ends
_MIDDLE_50: Final = (0.25, 0.5, 0.75)


@dataclass(frozen=True)
class LineFigures:
    """One line.

    Args:
        rms_px: root mean square width, the diffraction's tails cut at 20 px [px].
        middle_50_px: width of the middle half of the light [px].
        asymmetry_px: centre of gravity less median [px].
        electrons: the line's light [electrons].
        bound_px: the Cramer-Rao bound of its position [px].
        gravity_px: standard deviation of the thesis's reading, the centre of gravity of what is
            above a third of the peak [px].
    """

    rms_px: float
    middle_50_px: float
    asymmetry_px: float
    electrons: float
    bound_px: float
    gravity_px: float


def traced_lines(assembly: Assembly, positions: Array) -> StripeProfiles:
    """Return the lines of an LED at 1.5 m, at places (N, 2) of the field, u and v."""
    points = FOCUSED_MM * np.column_stack([positions, np.ones(len(positions))])
    return TracedStripes(assembly, LONG_ROW, BLUR, _RAYS).shapes(points)


def line_figures(assembly: Assembly, width_mm: float, positions: Array) -> tuple[LineFigures, ...]:
    """Return the figures of lines of an LED at 1.5 m, at places (N, 2) of the field, u and v.

    Args:
        assembly: lens, stop and sensor.
        width_mm: the stop's width, by which ambient light comes in [mm].
        positions: x/z and y/z, shape (N, 2).
    """
    lines = traced_lines(assembly, positions)
    share = lines.cell_sr / lines.total_sr[:, None]
    offset = lines.centres_px - lines.centroid_px[:, None]
    rms = np.sqrt((share * offset**2).sum(axis=1))
    quantiles = _quantiles(lines)
    background = BACKGROUND_ELECTRONS_PER_MM * width_mm
    bound, gravity = line_bound(lines, background), gravity_error(lines, background)
    return tuple(
        LineFigures(
            float(rms[line]),
            float(quantiles[line, 2] - quantiles[line, 0]),
            float(np.round(lines.centroid_px[line] - quantiles[line, 1], 9) + 0.0),
            float(lines.total_sr[line] * ELECTRONS_PER_SR),
            float(bound[line]),
            float(gravity[line]),
        )
        for line in range(len(positions))
    )


def line_bound(lines: StripeProfiles, background_electrons: float) -> Array:
    """Return the Cramer-Rao bounds of lines' positions, their brightness unknown too, (N,) [px]."""
    noise = PixelNoise(READ_NOISE_ELECTRONS, 0.0, background_electrons)
    moved = shifted_stripes([lines], LONG_ROW.count)
    electrons = moved.mean_sr * ELECTRONS_PER_SR, moved.slope_sr_per_px * ELECTRONS_PER_SR
    return position_bound(*electrons, noise.variance_electrons2)[:, 0]


def gravity_error(lines: StripeProfiles, background_electrons: float) -> Array:
    """Simulate the thesis's reading of each line, and return its standard deviation, (N,) [px].

    Noisy exposures of the line at all places within a pixel; pixels above a third of the
    brightest, within the line's extent, give the centre of gravity (section 4.2.2, [4.1]). The
    error that depends on the place within a pixel is in it, a constant one is not.
    """
    rng = np.random.default_rng(11)
    errors = np.empty(len(lines.cell_sr))
    for line, cells in enumerate(lines.cell_sr * ELECTRONS_PER_SR):
        padded = np.pad(cells, (CELLS, 0))
        moved = np.stack([np.roll(padded, shift) for shift in range(CELLS)])
        mean = moved.reshape(CELLS, -1, CELLS).sum(axis=2)
        extent = mean > _EXTENT * mean.max(axis=1, keepdims=True)
        pixel = np.flatnonzero(extent.any(axis=0))
        mean, extent = mean[:, pixel], extent[:, pixel]
        deviation = np.sqrt(mean + background_electrons + READ_NOISE_ELECTRONS**2)
        off = np.empty((CELLS, _EXPOSURES))
        for shift in range(CELLS):
            noise = rng.standard_normal((_EXPOSURES, len(pixel)))
            seen = np.where(extent[shift], mean[shift] + deviation[shift] * noise, 0.0)
            seen[seen < seen.max(axis=1, keepdims=True) / 3.0] = 0.0
            off[shift] = seen @ pixel / seen.sum(axis=1) - shift / CELLS
        errors[line] = np.std(off)
    return errors


def best_focus_mm(width_mm: float, place: StopPlace, places: Array) -> float:
    """Return the shift of the sensor at which lines at these places of the field are narrowest.

    Least is the root mean square of the widths of their middle halves; to 0.25 mm, from the
    paraxial image, negative towards the lens. The widths of every stop here have one minimum.

    Raises:
        NoConvergence: they still become narrower at NEAREST_MM.
    """

    @cache
    def width(shift: float) -> float:
        quantiles = _quantiles(traced_lines(stopped_lens(width_mm, place, shift), places))
        return root_mean_square((quantiles[:, 2] - quantiles[:, 0]).tolist())

    best = 0.0
    while width(best - 2.0) < width(best):
        best -= 2.0
        if best <= NEAREST_MM:
            raise NoConvergence(
                f"the lines of a stop of {width_mm} mm {place} become narrower as far as "
                f"{NEAREST_MM} mm; look for the best focus farther away"
            )
    for step in _STEPS_MM:
        best = min((best, best - step, best + step), key=width)
    return best


def root_mean_square(values: Sequence[float]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def distortion_px(assembly: Assembly, terms: tuple[Term, ...] = ()) -> float:
    """Return what seven parameters, and distortion's terms, leave over the field, RMS [px]."""
    return fitted(assembly, traced_readings(assembly, field_points((11, 5, 3))), terms).rms_px


def coma_free_stop_mm() -> float:
    """Return where on the axis a stop takes the lens's third-order coma away [mm].

    By Seidel's sums for the sphere of the same profile; 0 is the plane face.
    """

    def coma(z: float) -> float:
        shapes = (Plane(), Conic(-RADIUS_MM))
        lens = Lens(shapes, (THICKNESS_MM,), (INDEX,), Aperture(WIDTH_MM, WIDTH_MM, "elliptical"))
        stack = Assembly((Stop(Aperture(1.0), z), lens), 40.0).stack()
        return seidel_sums(paraxial_system(stack), Conjugates(-FOCUSED_MM, 0)).coma_f

    return float(brentq(coma, -30.0, 0.0))


def _quantiles(lines: StripeProfiles) -> Array:
    """Return the readings below which 25, 50 and 75 % of each line's light lie, shape (N, 3)."""
    found = np.empty((len(lines.cell_sr), len(_MIDDLE_50)))
    for line, cells in enumerate(lines.cell_sr):
        below = np.concatenate([[0.0], np.cumsum(cells)])
        edges = lines.first_px[line] - 0.5 + np.arange(len(below)) / CELLS
        found[line] = np.interp(np.array(_MIDDLE_50) * below[-1], below, edges)
    return found
