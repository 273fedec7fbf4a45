"""Errors of a fit where the line-spread function varies along the sensor."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from compute.optics.stripe_optics.stripe_profile import CELLS, Blur, StripeProfiles
from compute.optics.stripe_optics.traced_stripes import RaySampling, TracedStripes
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.peaks import PeakFlag
from validation.aberrations.thesis_lens import FOCUSED_MM, stopped_lens
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

LIGHT: Final = 1e5
READ_NOISE: Final = 20.0
NODES: Final = 25
FIELD_END: Final = 0.6
"""Lines are traced from the middle of the field to this part of its end."""
PLACES: Final = (0.0875, 0.2375, 0.3875, 0.5375)
"""Places of the lines that are fitted, between the nodes."""

GAUSSIAN, FROM_MIDDLE, BY_PLACE = "a Gaussian", "the middle's shape", "the shape by place"

_UNIT_PX: Final = 2.0
_HALF_PX: Final = 24


@dataclass(frozen=True)
class PlaceErrors:
    """Errors with one of the shapes.

    Args:
        rms_px: about their mean.
        offset_px: their mean.
        nees: mean of the squared errors about their mean, in stated deviations.
        poor: share flagged POOR_FIT.
    """

    rms_px: float
    offset_px: float
    nees: float
    poor: float


@dataclass(frozen=True)
class PlaceFigures:
    """A line at a place in the field: its bound by its own shape, and errors by the shape used."""

    field: float
    bound_px: float
    errors: dict[str, PlaceErrors]


@cache
def _lines(fields: tuple[float, ...]) -> StripeProfiles:
    assembly = stopped_lens(2.0, "on the plane face", -0.5)
    optics = TracedStripes(assembly, LONG_ROW, Blur(950.0, 3.0), RaySampling(257, max_rays=257))
    points = [[field * FIELD_U, 0.0, 1.0] for field in fields]
    return optics.shapes(FOCUSED_MM * np.array(points))


def gravity_px(lines: StripeProfiles) -> Array:
    """Return centres of gravity of what is within 24 px of the lines', shape (N,)."""
    centre: Array = lines.centroid_px
    for _ in range(4):
        near = np.abs(lines.centres_px - centre[:, None]) < _HALF_PX
        light = lines.cell_sr * near
        centre = (light * lines.centres_px).sum(axis=1) / light.sum(axis=1)
    return centre


def place_figures(field: float, count: int, seed: int = 7) -> PlaceFigures:
    """Fit ``count`` exposures at each of the 16 places within a pixel.

    Args:
        field: place along the row, as a part of the field's end.
        count: exposures at each.
        seed: of the noise.
    """
    rng = np.random.default_rng([seed, round(1000 * field)])
    nodes, line = _lines(tuple(np.linspace(0.0, FIELD_END, NODES).tolist())), _lines((field,))
    centre = gravity_px(line)
    shift = int(np.rint(centre[0])) - MIDDLE_PX
    own = LineSpreadFunction.from_lines(
        line.cell_sr, line.first_px - shift, centre - shift, CELLS, unit_px=_UNIT_PX
    )
    cells = np.repeat(np.arange(CELLS), count)
    electrons, position = _moved(line, shift, float(centre[0]), cells)
    lines = expose(electrons, READ_NOISE, rng)
    by_place = LineSpreadFunction.from_lines(
        nodes.cell_sr, nodes.first_px - shift, gravity_px(nodes) - shift, CELLS, unit_px=_UNIT_PX
    )
    middle = LineSpreadFunction.from_lines(
        nodes.cell_sr[:1], nodes.first_px[:1], gravity_px(nodes)[:1], CELLS, unit_px=_UNIT_PX
    )
    known = FitSettings(width_px=_UNIT_PX, width_log_sigma=0.0, max_joint_peaks=1)
    free = FitSettings(width_px=_UNIT_PX, width_log_sigma=np.inf, max_joint_peaks=1)
    noise = line_noise(READ_NOISE)
    bound = joint_position_bounds(
        position[::count, None], [LIGHT], AMBIENT, PIXELS, known, noise, own
    )
    start = nearest(find(lines, known.search, READ_NOISE), position, _UNIT_PX, 1000.0, rng).peaks
    errors = {}
    for name, settings, shape in (
        (GAUSSIAN, free, LineSpreadFunction.gaussian()),
        (FROM_MIDDLE, free, middle),
        (BY_PLACE, known, by_place),
    ):
        found = fit_scans(lines, settings, noise, shape, start)
        row, peak = np.arange(len(position)), match_true_peaks(found, position)
        error = found.position_px[row, peak] - position
        offset = float(error.mean())
        errors[name] = PlaceErrors(
            float(np.sqrt(np.mean((error - offset) ** 2))),
            offset,
            float(np.mean(((error - offset) / found.sigma_px[row, peak]) ** 2)),
            float(np.mean((found.flags[row, peak] & PeakFlag.POOR_FIT) != 0)),
        )
    return PlaceFigures(field, float(np.sqrt(bound.mean())), errors)


def _moved(
    line: StripeProfiles, shift: int, centre: float, cells: np.ndarray
) -> tuple[Array, Array]:
    """Return mean electrons (N, PIXELS) of one line moved by cells, and its positions (N,)."""
    away = np.abs(line.centres_px[0] - centre) < _HALF_PX
    share = np.where(away, line.cell_sr[0], 0.0)
    share = share[away] / share.sum()
    first = (int(line.first_px[0]) - shift) * CELLS + int(np.flatnonzero(away)[0])
    fine = np.zeros((len(cells), PIXELS * CELLS))
    fine[np.arange(len(cells))[:, None], first + cells[:, None] + np.arange(len(share))] = (
        LIGHT * share
    )
    return fine.reshape(len(cells), PIXELS, CELLS).sum(axis=2), centre - shift + cells / CELLS
