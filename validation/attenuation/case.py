"""Case attenuation: [3.28] and [3.29], spherical against cylindrical lens, by traced rays."""

from typing import Final

import numpy as np
from scipy.optimize import brentq

from validation.aberrations.thesis_lens import WIDTH_MM
from validation.attenuation.peak_signals import (
    DISTANCE_MM,
    Setting,
    background_ratio,
    best_focus_mm,
    cylinder_peak_sr,
    focal_length_mm,
    perfect_sphere_peak_sr,
    ratio,
    thin_ratio,
)
from validation.result_tables import Cell, ResultTable, TablesCase

MEASURED: Final = 101.55
"""[3.28]."""
SPHERE_LEVEL: Final = 33918.0
CYLINDER_LEVEL: Final = 334.0
"""Section 3.6: peaks less background, of 65535."""
SPHERE_SNR: Final = 5.546
CYLINDER_SNR: Final = 1.035
"""[3.29]: target by background."""

TARGETS_MM: Final = (5.0, 8.0, 10.0, 15.0, 20.0, 30.0, 50.0)
FOCAL_RATIOS: Final = (1.4, 2.0, 2.8, 4.0)
TILTS_DEG: Final = (1.0, 2.0)


def compute_tables() -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the ratios by what the text leaves open, and where the measured one lies."""
    focus = {target: best_focus_mm(target) for target in TARGETS_MM}
    (same, others), perfect, levels = _same_lens(focus), _camera_lens(focus), _levels()
    ratios = _figures(same, "both brightest")
    smallest, largest = min(ratios), max(ratios)
    size = target_for_measured_mm()
    background_s, background_c = backgrounds()
    findings = (
        (
            "The ratio is not one of lenses. In focus a pixel sees a target through the whole "
            "sphere, but through a strip of the cylinder only, as high as the target looks from "
            "there: (pi / 4) (A/f)^2 f d / (W D), that is inversely as the target's size D and "
            "as the square of the sphere's f-number f/A. Neither is in section 3.6."
        ),
        (
            f"{MEASURED} is plausible. A sphere of the cylinder's own profile, each where its "
            f"target is brightest, gives it for targets of {size:.1f} mm, and from "
            f"{smallest:.0f} to {largest:.0f} over 5 "
            "to 50 mm. Behind a corrected camera lens of the same focal length it comes out for "
            f"targets of 10 to 30 mm at f/{focal_ratio_for_measured(10.0, focus[10.0][1]):.1f} to "
            f"f/{focal_ratio_for_measured(30.0, focus[30.0][1]):.1f}."
        ),
        (
            f"Focus changes it by up to {_largest_change(others, 'cylinder at paraxial'):.1f} "
            f"(the cylinder's alone), target size by {largest / smallest:.1f}, "
            "and a line turned against the columns by 2 degrees, over the 300 rows averaged, by up "
            f"to {_largest_change(others, 'line turned 2 deg'):.1f}, that of the smallest target. "
            "Automatic gain between the two pictures, had it been on, would make it meaningless; "
            "the text does not say."
        ),
        (
            f"[3.28] and [3.29] together give backgrounds of {background_s:.0f} and "
            f"{background_c:.0f} (9410 to 9680 for the rounding of 1.035), and so peaks of "
            f"{SPHERE_LEVEL + background_s:.0f} and {CYLINDER_LEVEL + background_c:.0f}: the "
            "text's over 40000 and slightly over 9700. Even surroundings would be "
            f"{background_ratio():.1f} times as bright behind the cylinder, which lets light in "
            f"from a higher field, not {background_c / background_s:.2f} times: it is the "
            "background that it does not weaken. Signal to background falls by as much as the "
            "signal, and that is what a filter and a strobe are for."
        ),
        (
            f"Assumed: the lens of section 3.4 as the cylinder (section 4.2.2 has it on this "
            f"camera), even disks {DISTANCE_MM:.0f} mm away in the middle of the field, pixels of "
            f"10 x 10 um (6.4 x 4.8 mm, 640 x 480), no diffraction, a response that is linear."
        ),
    )
    return (same, others, perfect, levels), findings


def backgrounds() -> tuple[float, float]:
    """Return the backgrounds behind sphere and cylinder that [3.28] and [3.29] give."""
    return SPHERE_LEVEL / (SPHERE_SNR - 1.0), CYLINDER_LEVEL / (CYLINDER_SNR - 1.0)


def target_for_measured_mm() -> float:
    """Return the target whose ratio is the measured one, both lenses where it is brightest [mm]."""

    def excess(target: float) -> float:
        return ratio(Setting(target, *best_focus_mm(target))) - MEASURED

    return float(brentq(excess, 5.0, 12.0, xtol=0.2))


def focal_ratio_for_measured(target_mm: float, cylinder_focus_mm: float) -> float:
    """Return the focal ratio of a perfect sphere at which the ratio is the measured one."""
    cylinder = cylinder_peak_sr(target_mm, cylinder_focus_mm)

    def excess(focal_ratio: float) -> float:
        return perfect_sphere_peak_sr(target_mm, focal_ratio) / cylinder - MEASURED

    return float(brentq(excess, 0.5, 50.0))


def _same_lens(focus: dict[float, tuple[float, float]]) -> tuple[ResultTable, ResultTable]:
    own = focal_length_mm() / WIDTH_MM
    best: list[tuple[Cell, ...]] = []
    others: list[tuple[Cell, ...]] = []
    for target, (sphere, cylinder) in focus.items():
        brightest = ratio(Setting(target, sphere, cylinder))
        best.append((target, sphere, cylinder, brightest, thin_ratio(target, own), MEASURED))
        turned = (
            ratio(Setting(target, sphere, cylinder, float(np.radians(tilt)))) for tilt in TILTS_DEG
        )
        unfocused = (ratio(Setting(target, position, 0.0)) for position in (sphere, 0.0))
        others.append((target, brightest, *turned, *unfocused))
    return (
        ResultTable(
            "attenuation, a sphere of the cylinder's profile and width, by target and focus [mm]",
            (
                "target", "sphere's focus", "cylinder's focus", "both brightest", "thin lenses",
                "thesis",
            ),
            tuple(best),
        ),
        ResultTable(
            "the same, the line turned against the columns, or at the paraxial focus [mm]",
            (
                "target", "both brightest", "line turned 1 deg", "line turned 2 deg",
                "cylinder at paraxial", "both at paraxial",
            ),
            tuple(others),
        ),
    )  # fmt: skip


def _camera_lens(focus: dict[float, tuple[float, float]]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for target, (_, cylinder) in focus.items():
        peak = cylinder_peak_sr(target, cylinder)
        ratios = (perfect_sphere_peak_sr(target, stop) / peak for stop in FOCAL_RATIOS)
        rows.append((target, *ratios, focal_ratio_for_measured(target, cylinder)))
    return ResultTable(
        "attenuation, a camera lens without aberration and as long, by target and f-number [mm]",
        (
            "target", *(f"f/{stop:g}" for stop in FOCAL_RATIOS), f"f-number for {MEASURED}",
        ),
        tuple(rows),
    )  # fmt: skip


def _levels() -> ResultTable:
    sphere, cylinder = backgrounds()
    return ResultTable(
        "grey levels of section 3.6 [of 65535]",
        ("", "sphere", "cylinder", "sphere / cylinder", "even surroundings"),
        (
            ("target less background", SPHERE_LEVEL, CYLINDER_LEVEL, MEASURED, None),
            ("target by background, [3.29]", SPHERE_SNR, CYLINDER_SNR, None, None),
            (
                "background, from both", sphere, cylinder, sphere / cylinder,
                1.0 / background_ratio(),
            ),
            ("target, from both", SPHERE_LEVEL + sphere, CYLINDER_LEVEL + cylinder, None, None),
        ),
    )  # fmt: skip


def _figures(table: ResultTable, heading: str) -> list[float]:
    return [float(str(cell)) for cell in table.column(heading)]


def _largest_change(table: ResultTable, heading: str) -> float:
    """Return the largest ratio to the column of both lenses where the target is brightest."""
    pairs = zip(_figures(table, heading), _figures(table, "both brightest"), strict=True)
    return max(max(one / other, other / one) for one, other in pairs)


CASE: Final = TablesCase(
    "attenuation",
    "signal behind a cylindrical lens against that behind a spherical one",
    "section 3.6, [3.28] and [3.29]",
    compute_tables,
)
