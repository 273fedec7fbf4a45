"""Case marker-capacity: number of simultaneous markers up to which correspondence holds."""

from typing import Final

from compute.planning.ghost_points import candidates, intersecting_points
from compute.reconstruction.correspondence.candidates import MatchSettings
from validation.marker_capacity.monte_carlo import (
    FRAMES,
    MARKERS,
    MERGED_PX,
    PREDICTED_MM,
    SCENES,
    Scene,
    Shares,
    capacity,
)
from validation.marker_capacity.rigs import RIGS
from validation.progress import report_progress
from validation.result_tables import Cell, ResultTable, TablesCase

RESOLVED_FRACTION: Final = 0.9
"""Share of the frames that must be resolved wholly for a configuration to hold so many."""

Figures = dict[tuple[int, Scene, int], Shares]


def compute_tables(
    rigs: tuple[int, ...] = tuple(range(len(RIGS))),
    scenes: tuple[Scene, ...] = SCENES,
    markers: tuple[int, ...] = MARKERS,
    frames: int = FRAMES,
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the shares by configuration, scene and number of markers."""
    figures: Figures = {}
    jobs = [(rig, scene, count) for rig in rigs for scene in scenes for count in markers]
    weight = [float(count) ** 2 for _, _, count in jobs]
    done = 0.0
    for job, part in zip(jobs, weight, strict=True):
        rig, scene, count = job
        report_progress(done / sum(weight), f"{RIGS[rig]().name}, {scene.label}, {count} markers")
        figures[job] = capacity(rig, scene, count, frames)
        done += part
    tables = (
        _intersections(rigs, markers),
        *(_by_scene(figures, rigs, scene, markers) for scene in scenes),
        _capacities(figures, rigs, scenes, markers),
    )
    return tables, _findings(figures, frames)


def _intersections(rigs: tuple[int, ...], markers: tuple[int, ...]) -> ResultTable:
    sensors = sorted({RIGS[rig]().sensors for rig in rigs})
    rows: list[tuple[Cell, ...]] = [
        (
            str(count),
            *(str(intersecting_points(count, of)) for of in sensors),
            *(f"{candidates(count, of):.3g}" for of in sensors),
        )
        for count in markers
    ]
    return ResultTable(
        "Points in which lines meet in the plane [2.15], and combinations in space",
        (
            "markers",
            *(f"points, {of} sensors" for of in sensors),
            *(f"combinations, {of} sensors" for of in sensors),
        ),
        tuple(rows),
    )


def _by_scene(
    figures: Figures, rigs: tuple[int, ...], scene: Scene, markers: tuple[int, ...]
) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for count in markers:
        cells: list[Cell] = [str(count)]
        for rig in rigs:
            share = figures[rig, scene, count]
            cells.append(
                f"{share.resolved:.0%} / {share.ambiguous:.0%} / {share.wrong:.0%} "
                f"({share.markers:.0%})"
            )
        rows.append(tuple(cells))
    return ResultTable(
        f"Frames resolved / in doubt / wrong without a mark (markers resolved): {scene.label}",
        ("markers", *(RIGS[rig]().name for rig in rigs)),
        tuple(rows),
    )


def capacity_of(figures: Figures, rig: int, scene: Scene, markers: tuple[int, ...]) -> int:
    """Return up to how many markers a configuration resolves wholly, in HELD of the frames."""
    most = 0
    for count in markers:
        if figures[rig, scene, count].resolved < RESOLVED_FRACTION:
            break
        most = count
    return most


def _capacities(
    figures: Figures,
    rigs: tuple[int, ...],
    scenes: tuple[Scene, ...],
    markers: tuple[int, ...],
) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for rig in rigs:
        one = RIGS[rig]()
        cells: list[Cell] = [one.name, str(one.sensors), f"{one.sigma_px.mean():.4f}"]
        cells += [str(capacity_of(figures, rig, scene, markers)) for scene in scenes]
        rows.append(tuple(cells))
    return ResultTable(
        f"Markers lit at once, up to which {RESOLVED_FRACTION:.0%} of the frames are "
        "resolved wholly",
        ("configuration", "sensors", "noise [px]", *(scene.label for scene in scenes)),
        tuple(rows),
    )


def _findings(figures: Figures, frames: int) -> tuple[str, ...]:
    groups = sum(share.groups for share in figures.values())
    wrong = sum(share.wrong_groups for share in figures.values())
    rate = MatchSettings().max_error_rate
    return (
        (
            f"Of {groups} groups that were not marked as ambiguous {wrong} are wrong, "
            f"{wrong / max(groups, 1):.4%}; stated is {rate:.2%} at most. Wrong is a group with "
            "any peak that is not its marker's."
        ),
        (
            "Three sensors resolve one marker and no more, whatever the noise: every one of N^3 "
            "combinations meets. With predicted points "
            f"({PREDICTED_MM:g} mm in each coordinate) they do."
        ),
        (
            f"{frames} frames each. Markers are drawn evenly from the profile's volume, where all "
            "sensors see them, and read by perspective cameras calibrated there, with the "
            "Cramer-Rao bound of the profile's light and noise and the pixels' pattern; lines "
            f"nearer than {MERGED_PX:g} px are one peak, flagged as merged. What a calibration "
            "leaves comes on top: the scenes with 0.1 px."
        ),
        (
            "A frame is in doubt as soon as one marker is marked or left out; the share in "
            "brackets is that of the markers."
        ),
    )


CASE: Final = TablesCase(
    "marker-capacity",
    "how many markers lit at once each configuration holds before ambiguity",
    "section 2.3, [2.15], Figures 2.10 and 2.12; section 4.6",
    compute_tables,
)
