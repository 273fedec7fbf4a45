"""Lines of light by brute force: rays all over the pupil, and those kept that hit the pixels."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.optics.pixel_row import PixelRow
from compute.optics.stripe_optics.stripe_profile import CELLS
from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays

Array = NDArray[np.float64]

REPEATS = 12


@dataclass(frozen=True, eq=False)
class ScannedLine:
    """A line from R independent bundles; arrays of shape (R,), and (R, pixels).

    Args:
        total_sr: light of all of the line on the row's height, beyond the row's ends too.
        centroid_px: centre of gravity.
        sigma_px: standard deviation of the places.
        pixel_sr: light by pixel.
        edge_sr: light within a cell of the fine grid beside either edge of a pixel.
    """

    total_sr: Array
    centroid_px: Array
    sigma_px: Array
    pixel_sr: Array
    edge_sr: Array


def scan_line(
    assembly: Assembly, row: PixelRow, seen_mm: Array, rays: int, seed: int = 1
) -> ScannedLine:
    """Trace REPEATS bundles of ``rays`` from a point, spread over the plane of the first vertex.

    Shares with the code that it checks the tracer alone: no aiming, no fan, no interpolation.
    A bundle is a jittered grid, so the spread between bundles is the error of each.
    """
    rng = np.random.default_rng(seed)
    x, y, z = seen_mm
    source = np.array([x, -y, -z])
    first = assembly.elements[0]
    # Half as wide again as the opening, and more for what a turned one reaches.
    width, height = first.aperture.width_mm, min(first.aperture.height_mm, 200.0)
    turn = abs(np.sin(first.alignment.tilt_rad[2]))
    box = 0.75 * np.array([width + height * turn, height + width * turn])
    low = np.array(first.alignment.decentre_mm) - box
    high = np.array(first.alignment.decentre_mm) + box
    # Where in the opening the light of the row comes from: twice, closer each time.
    stack = assembly.stack()
    for _ in range(3):
        low, high = _light_of_row(assembly, stack, row, source, low, high, rng)
    bundles = []
    for _ in range(REPEATS):
        places = _jittered(low, high, rays, rng)
        directions = np.column_stack([places, np.full(len(places), first.z_mm)]) - source
        traced = trace_rays(stack, np.broadcast_to(source, directions.shape), directions)
        hit = (traced.status == RayStatus.ARRIVED) & (
            np.abs(traced.position_mm[:, 1]) <= row.height_mm / 2.0
        )
        distance = np.linalg.norm(directions, axis=1)
        area = np.prod(high - low) / len(places)
        light = area * directions[:, 2] / distance**3 * traced.transmittance.mean(axis=1)
        light, reading = light[hit], row.centre_px - traced.position_mm[hit, 0] / row.pitch_mm
        assert len(light) > 100, "too few rays hit the row to say anything"
        bundles.append((light, reading))
    total = np.array([light.sum() for light, _ in bundles])
    centroid = np.array([(light * at).sum() / light.sum() for light, at in bundles])
    sigma = np.array(
        [
            np.sqrt((light * (at - middle) ** 2).sum() / light.sum())
            for (light, at), middle in zip(bundles, centroid, strict=True)
        ]
    )
    edges = np.arange(row.count + 1) - 0.5
    pixel = np.array([np.histogram(at, edges, weights=light)[0] for light, at in bundles])
    beside = []
    for light, at in bundles:
        place = (at + 0.5) % 1.0
        near = (place < 1.0 / CELLS) | (place > 1.0 - 1.0 / CELLS)
        close = np.histogram(at[near], edges, weights=light[near])[0]
        # What lies just across an edge may be given to this side as well.
        across = np.pad(close, 1)
        beside.append(np.maximum(across[:-2], across[2:]) + close)
    return ScannedLine(total, centroid, sigma, pixel, np.array(beside))


def _light_of_row(assembly, stack, row, source, low, high, rng):
    """Return a box of the opening, in which all rays that meet the row lie."""
    places = _jittered(low, high, 60_000, rng)
    directions = np.column_stack([places, np.full(len(places), assembly.elements[0].z_mm)])
    directions -= source
    origins = np.broadcast_to(source, directions.shape)
    # A grid that is coarse beside the row's height: what lands within a few of its steps may
    # stand for a ray that meets it. Landing beside is asked of the lenses without their edges.
    bare = replace(stack, surfaces=tuple(replace(one, aperture=None) for one in stack.surfaces))
    height = trace_rays(bare, origins, directions).position_mm[:, 1]
    spread = np.nanmax(height) - np.nanmin(height)
    near = np.abs(height) <= row.height_mm / 2.0 + 0.03 * spread
    passed = near & (trace_rays(stack, origins, directions).status == RayStatus.ARRIVED)
    if not passed.any():
        return low, high
    margin = 0.05 * (high - low)
    sides = [places[near].min(axis=0), places[near].max(axis=0)]
    sides[0][0], sides[1][0] = places[passed, 0].min(), places[passed, 0].max()
    return (
        np.maximum(low, sides[0] - margin),
        np.minimum(high, sides[1] + margin),
    )


def _jittered(low, high, count, rng):
    """Return one random place in each cell of a grid over a box."""
    side = int(np.sqrt(count))
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1)
    places = (cells.reshape(-1, 2) + rng.random((side * side, 2))) / side
    return low + (high - low) * places
