"""All cases by their names on the command line."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Final

from validation.aberrations_polynomials import CASE as TABLES_3_1_3_2
from validation.aberrations_seidel import CASE as SEIDEL
from validation.attenuation import CASE as ATTENUATION
from validation.calibration_convergence import CASE as CONVERGENCE
from validation.cases import CASES, Case
from validation.close_peaks import CASE as CLOSE_PEAKS
from validation.distortion_tables import TABLE_A1, TABLE_A2
from validation.interpolators import CASE as INTERPOLATORS
from validation.labels import CASE as LABELS
from validation.map_bound import CASE as MAP_BOUND
from validation.marker_capacity import CASE as MARKER_CAPACITY
from validation.partial_view import CASE as PARTIAL_VIEW
from validation.passive_detection import CASE as PASSIVE_DETECTION
from validation.peak_efficiency import CASE as PEAK_EFFICIENCY
from validation.pointer_tip import CASE as POINTER_TIP
from validation.section_6_1 import CASE as SECTION_6_1
from validation.section_6_2 import CASE as SECTION_6_2
from validation.signal_ordering import TABLE_4_1, TABLE_4_2, TABLE_4_3
from validation.signal_scenes import CASE as TABLE_4_5
from validation.signal_separation import CASE as TABLE_4_4
from validation.signal_table_c import CASE as TABLE_C
from validation.skew_effect import CASE as SKEW_EFFECT
from validation.stop_and_focus import CASE as STOP_AND_FOCUS
from validation.strobed_tools import CASE as STROBED_TOOLS
from validation.table_1_1 import CASE as TABLE_1_1
from validation.table_5_5 import CASE as TABLE_5_5
from validation.table_5_generated import TABLE_5_6, TABLE_5_7, TABLE_5_8, TABLE_5_9
from validation.table_5_optimisation import (
    TABLE_5_10,
    TABLE_5_11,
    TABLE_5_12,
    TABLE_5_13,
    TABLE_5_14,
)
from validation.table_5_simulated import TABLE_5_1, TABLE_5_2, TABLE_5_3, TABLE_5_4
from validation.table_6_1 import TABLE_6_1
from validation.table_6_2 import TABLE_6_2
from validation.tables import TablesCase
from validation.wand import CASE as WAND


def _drawn(case: TablesCase, module: str) -> TablesCase:
    """Return a case with its picture, by the ``draw`` of a module of this package.

    Matplotlib, which the module brings, is loaded by who wants the picture.
    """

    def draw(path: Path) -> None:
        import_module(f"validation.{module}").draw(path)

    return replace(case, picture=draw)


_TABLES: Final[tuple[TablesCase, ...]] = (
    TABLE_1_1,
    TABLE_5_1,
    TABLE_5_2,
    TABLE_5_3,
    TABLE_5_4,
    TABLE_5_5,
    TABLE_5_6,
    TABLE_5_7,
    TABLE_5_8,
    TABLE_5_9,
    TABLE_5_10,
    TABLE_5_11,
    TABLE_5_12,
    TABLE_5_13,
    TABLE_5_14,
    _drawn(SECTION_6_1, "section_6_1_picture"),
    _drawn(SECTION_6_2, "section_6_2_picture"),
    TABLE_6_1,
    TABLE_6_2,
    LABELS,
    TABLE_A1,
    TABLE_A2,
    SEIDEL,
    _drawn(SKEW_EFFECT, "skew_picture"),
    _drawn(STOP_AND_FOCUS, "stop_picture"),
    ATTENUATION,
    _drawn(PASSIVE_DETECTION, "passive_picture"),
    _drawn(PEAK_EFFICIENCY, "peak_efficiency_picture"),
    _drawn(CLOSE_PEAKS, "close_peaks_picture"),
    MAP_BOUND,
    _drawn(MARKER_CAPACITY, "marker_capacity_picture"),
    _drawn(INTERPOLATORS, "interpolators_picture"),
    TABLES_3_1_3_2,
    TABLE_4_1,
    TABLE_4_2,
    TABLE_4_3,
    TABLE_4_4,
    TABLE_4_5,
    TABLE_C,
    CONVERGENCE,
    WAND,
    PARTIAL_VIEW,
    POINTER_TIP,
    STROBED_TOOLS,
)

ALL_CASES: Final[dict[str, Case | TablesCase]] = {
    **CASES,
    **{case.name: case for case in _TABLES},
}
"""Tests of chapter 5, then tables, sections and questions."""
