"""Registry of the cases by their names on the command line."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Final

from validation.aberrations.seidel_case import CASE as SEIDEL
from validation.aberrations.tables_3_1_and_3_2 import CASE as TABLES_3_1_3_2
from validation.aberrations.tables_a_1_and_a_2 import TABLE_A1, TABLE_A2
from validation.attenuation.case import CASE as ATTENUATION
from validation.bad_inputs.case import CASE as BAD_INPUTS
from validation.calibration_convergence.case import CASE as CONVERGENCE
from validation.close_peaks.case import CASE as CLOSE_PEAKS
from validation.fusion.case import CASE as FUSION
from validation.interpolators.case import CASE as INTERPOLATORS
from validation.labels.case import CASE as LABELS
from validation.labels.heavy_tails import CASE as LABEL_TAILS
from validation.map_bound.case import CASE as MAP_BOUND
from validation.map_holes.case import CASE as MAP_HOLES
from validation.map_outside.case import CASE as MAP_OUTSIDE
from validation.marker_capacity.case import CASE as MARKER_CAPACITY
from validation.partial_view.case import CASE as PARTIAL_VIEW
from validation.passive_detection.case import CASE as PASSIVE_DETECTION
from validation.peak_efficiency.case import CASE as PEAK_EFFICIENCY
from validation.pixels.case import CASE as PIXELS
from validation.pointer_tip.case import CASE as POINTER_TIP
from validation.random_rigs.case import CASE as RANDOM_RIGS
from validation.reliability.case import CASE as RELIABILITY
from validation.result_tables import TablesCase
from validation.section_6_1.two_active_markers import CASE as SECTION_6_1
from validation.section_6_2.three_passive_markers import CASE as SECTION_6_2
from validation.signal_chain.table_4_4 import CASE as TABLE_4_4
from validation.signal_chain.table_4_5 import CASE as TABLE_4_5
from validation.signal_chain.table_c import CASE as TABLE_C
from validation.signal_chain.tables_4_1_to_4_3 import TABLE_4_1, TABLE_4_2, TABLE_4_3
from validation.skew_effect.case import CASE as SKEW_EFFECT
from validation.stop_and_focus.case import CASE as STOP_AND_FOCUS
from validation.strobed_tools.case import CASE as STROBED_TOOLS
from validation.table_1_1.budget_case import CASE as ACCURACY_BUDGET
from validation.table_1_1.case import CASE as TABLE_1_1
from validation.table_5.table_5_5 import CASE as TABLE_5_5
from validation.table_5.tables_5_1_to_5_4 import TABLE_5_1, TABLE_5_2, TABLE_5_3, TABLE_5_4
from validation.table_5.tables_5_6_to_5_9 import TABLE_5_6, TABLE_5_7, TABLE_5_8, TABLE_5_9
from validation.table_5.tables_5_10_to_5_14 import (
    TABLE_5_10,
    TABLE_5_11,
    TABLE_5_12,
    TABLE_5_13,
    TABLE_5_14,
)
from validation.table_6.table_6_1 import TABLE_6_1
from validation.table_6.table_6_2 import TABLE_6_2
from validation.tests_5_1_to_5_8 import CASES, Case
from validation.wand.case import CASE as WAND
from validation.wand_from_readings.case import CASE as WAND_FROM_READINGS


def _with_picture(case: TablesCase, module: str) -> TablesCase:
    """Return a case with its picture, by the ``draw`` of a module of this package.

    Matplotlib, which the module brings, is loaded by who wants the picture.
    """

    def draw(path: Path) -> None:
        import_module(f"validation.{module}").draw(path)

    return replace(case, picture=draw)


_TABLES: Final[tuple[TablesCase, ...]] = (
    TABLE_1_1,
    ACCURACY_BUDGET,
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
    _with_picture(SECTION_6_1, "section_6_1.picture"),
    _with_picture(SECTION_6_2, "section_6_2.picture"),
    TABLE_6_1,
    TABLE_6_2,
    LABELS,
    LABEL_TAILS,
    TABLE_A1,
    TABLE_A2,
    SEIDEL,
    _with_picture(SKEW_EFFECT, "skew_effect.picture"),
    _with_picture(STOP_AND_FOCUS, "stop_and_focus.picture"),
    ATTENUATION,
    _with_picture(PASSIVE_DETECTION, "passive_detection.picture"),
    _with_picture(PEAK_EFFICIENCY, "peak_efficiency.picture"),
    _with_picture(CLOSE_PEAKS, "close_peaks.picture"),
    MAP_BOUND,
    MAP_HOLES,
    MAP_OUTSIDE,
    _with_picture(MARKER_CAPACITY, "marker_capacity.picture"),
    _with_picture(INTERPOLATORS, "interpolators.picture"),
    TABLES_3_1_3_2,
    TABLE_4_1,
    TABLE_4_2,
    TABLE_4_3,
    TABLE_4_4,
    TABLE_4_5,
    TABLE_C,
    PIXELS,
    CONVERGENCE,
    RANDOM_RIGS,
    BAD_INPUTS,
    RELIABILITY,
    WAND,
    WAND_FROM_READINGS,
    PARTIAL_VIEW,
    POINTER_TIP,
    STROBED_TOOLS,
    FUSION,
)

ALL_CASES: Final[dict[str, Case | TablesCase]] = {
    **CASES,
    **{case.name: case for case in _TABLES},
}
"""Tests of chapter 5, then tables, sections and questions."""
