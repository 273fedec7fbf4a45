"""Case interpolators: interpolating and penalised correction maps, by pitch and noise."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.mapping.build import build_table
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.result import MappingMethod, MappingSettings
from validation.map_bound.scene import Scene, bar_scene
from validation.result_tables import Cell, ResultTable, TablesCase

Array = NDArray[np.float64]

LOW_MM: Final = (-380.0, -380.0, 1500.0)
HIGH_MM: Final = (380.0, 380.0, 1900.0)
"""What all four sensors see, so that no node is missing."""
SENSORS: Final = (0, 2)
"""One that measures along an axis of the grid, and one across it."""
CELLS: Final = ((2, 2, 1), (4, 4, 2), (6, 6, 3), (10, 10, 5))
NOISES_PX: Final = (0.002, 0.015, 0.1)
"""Of a node: a line averaged over fifty exposures, one exposure, places known to 0.05 mm."""
TEST: Final = 400
METHODS: Final[tuple[MappingMethod, ...]] = ("trilinear", "tricubic", "b-spline")
_BLOCK: Final = 128


@dataclass(frozen=True)
class Comparison:
    """Maps of one grid with one noise.

    Args:
        pitch_mm: edge of a cell across, the depth's is the same to a few percent [mm].
        nodes: how many there are.
        noise_px: of a node.
        rms_px: error of the correction at points between the nodes, by method.
    """

    pitch_mm: float
    nodes: int
    noise_px: float
    rms_px: dict[MappingMethod, float]


@dataclass(frozen=True, eq=False)
class _Exact:
    """Points and their readings without noise."""

    points_mm: Array
    readings_px: Array


def compare_maps(
    cells: tuple[tuple[int, int, int], ...], noises_px: tuple[float, ...], test: int
) -> tuple[tuple[Comparison, ...], float]:
    """Map the bar's misfit to seven-parameter cameras, and compare at ``test`` points between.

    Returns:
        The comparisons, and the misfit's RMS [px].
    """
    scene = bar_scene()
    nodes = [_exact(scene, _lattice(count)) for count in cells]
    between = np.random.default_rng(1).uniform(LOW_MM, HIGH_MM, (test, 3))
    unseen = _exact(scene, between)
    geometry = [scene.geometry[sensor] for sensor in SENSORS]
    models = calibrate(unseen.points_mm, unseen.readings_px, geometry).models
    misfit = CameraStack.of(models).project(between) - unseen.readings_px
    found = []
    for count, exact in zip(cells, nodes, strict=True):
        for noise in noises_px:
            rms = _errors(models, exact, noise, between, misfit)
            pitch = (HIGH_MM[0] - LOW_MM[0]) / count[0]
            found.append(Comparison(pitch, len(exact.points_mm), noise, rms))
    return tuple(found), float(np.sqrt((misfit**2).mean()))


def _errors(
    models: tuple[SensorModel, ...], exact: _Exact, noise_px: float, between: Array, misfit: Array
) -> dict[MappingMethod, float]:
    rng = np.random.default_rng(2)
    readings = exact.readings_px + noise_px * rng.standard_normal(exact.readings_px.shape)
    measured = MappingMeasurements(exact.points_mm, readings, np.full(readings.shape, noise_px))
    rms = {}
    for method in METHODS:
        table = build_table(models, "", measured, settings=MappingSettings(method=method)).table
        error = table.at(between).value_px - misfit
        rms[method] = float(np.sqrt((error**2).mean()))
    return rms


def _lattice(cells: tuple[int, int, int]) -> Array:
    axes = [
        np.linspace(low, high, count + 1)
        for low, high, count in zip(LOW_MM, HIGH_MM, cells, strict=True)
    ]
    return np.stack([one.ravel() for one in np.meshgrid(*axes, indexing="ij")], axis=1)


def _exact(scene: Scene, points_mm: Array) -> _Exact:
    readings = [
        scene.device.image_points(points_mm[start : start + _BLOCK]).readings_px
        for start in range(0, len(points_mm), _BLOCK)
    ]
    return _Exact(points_mm, np.concatenate(readings)[:, SENSORS])


@cache
def all_comparisons() -> tuple[tuple[Comparison, ...], float]:
    """Return the case's comparisons and the misfit's RMS [px]."""
    return compare_maps(CELLS, NOISES_PX, TEST)


def compute_tables() -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the table of errors, and what it shows."""
    found, misfit = all_comparisons()
    return (errors_table(found),), findings(found, misfit)


def errors_table(found: tuple[Comparison, ...]) -> ResultTable:
    """Return one row for each grid and noise."""
    rows: list[tuple[Cell, ...]] = [
        (
            one.noise_px,
            one.pitch_mm,
            one.nodes,
            *(float(f"{one.rms_px[method]:.3g}") for method in METHODS),
            _best(one),
        )
        for one in sorted(found, key=lambda one: (one.noise_px, -one.pitch_mm))
    ]
    return ResultTable(
        "RMS error of the correction between the nodes [px]",
        ("noise of a node", "pitch [mm]", "nodes", *METHODS, "least"),
        tuple(rows),
    )


def findings(found: tuple[Comparison, ...], misfit_px: float) -> tuple[str, ...]:
    """Say which method to take."""
    best = [one for one in found if _best(one) == "b-spline"]
    rest = [one for one in found if _best(one) != "b-spline"]
    gain = [min(one.rms_px[m] for m in METHODS[:2]) / one.rms_px["b-spline"] for one in found]
    finest = min(found, key=lambda one: (one.pitch_mm, -one.noise_px))
    coarsest = max(found, key=lambda one: (one.pitch_mm, -one.noise_px))
    where = "; ".join(
        f"{one.nodes} nodes of {one.noise_px:g} px ({_best(one)} {one.rms_px[_best(one)]:.3g} px, "
        f"b-spline {one.rms_px['b-spline']:.3g} px)"
        for one in rest
    )
    return (
        (
            "Two sensors of the bar of Figure 5.2 with the stopped lens, seven parameters each; "
            f"what they leave over the volume that all see, {misfit_px:.3g} px RMS, is mapped "
            "from nodes on a grid, each read once with the noise given, and looked up between "
            "them."
        ),
        (
            f"The penalised B-spline is the best of the three in {len(best)} of {len(found)} "
            f"cases; the better of the interpolations has errors {min(gain):.2f} to "
            f"{max(gain):.2f} times as large. " + (f"It is not for {where}." if rest else "")
        ),
        (
            "The penalised spline is the default: it takes points anywhere, gains where there is "
            "noise or there are nodes enough, and says how sure it is. Few nodes of a smooth "
            "field, read with little noise, are better interpolated by cubics."
        ),
        (
            f"On the coarsest grid trilinear interpolation is off by "
            f"{coarsest.rms_px['trilinear']:.3g} px without much noise: the curvature of the "
            "field between the nodes. On the finest, with the most noise, interpolation keeps "
            f"the nodes' ({finest.rms_px['trilinear']:.3g} px trilinear, "
            f"{finest.rms_px['tricubic']:.3g} px tricubic, of {finest.noise_px:g} px), and the "
            f"penalised spline averages over neighbours ({finest.rms_px['b-spline']:.3g} px)."
        ),
    )


def _best(one: Comparison) -> MappingMethod:
    return min(METHODS, key=lambda method: one.rms_px[method])


CASE: Final = TablesCase(
    "interpolators",
    "maps: trilinear, tricubic and penalised B-spline, by pitch and noise of the nodes",
    "section 5.6 (its recommendation of space mapping)",
    compute_tables,
)
