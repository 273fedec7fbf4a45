"""Tables 5.10 to 5.14: the thesis's optimisation of eleven coefficients, repeated."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from validation.result_tables import Cell, ResultTable, TablesCase
from validation.table_5.calibration_frame import (
    SENSORS,
    STEPS,
    error_mm2,
    frame,
    free_directions,
    metric_coefficients,
    metric_models,
    mirrored_start,
    parameters,
    stepwise,
)
from validation.table_5.coefficient_tables import (
    Worked,
    coefficient_table,
    error_table,
    labelled_rows,
)
from validation.table_5.error_statistics import of_column, printed, statistics_tables
from validation.tests_5_1_to_5_8 import (
    AS_PUBLISHED,
    KNOWN_CAMERAS,
    METRIC,
    NORMALISED,
    generated_columns,
)
from validation.thesis_data import DFW_V500, LONG_DFW_V500, csv_rows
from validation.thesis_methods.dlt import CollinearityParameters
from validation.thesis_methods.eleven_parameter_bundle import (
    PARAMETER_ORDER,
    THESIS_SWEEPS,
    from_array,
    project_eleven_parameters,
)

Array = NDArray[np.float64]

LONG_PASSES: Final = 50


def _table_5_10() -> Worked:
    set_up, metric = parameters("5.10"), metric_coefficients()
    tables = (
        coefficient_table("coefficients as set up and as calibrated, mm", {
            "Table 5.10": set_up, "metric": metric,
        }),
        error_table({"Table 5.10": set_up, "metric": metric}),
    )  # fmt: skip
    distances = ", ".join(f"{value:.1f}" for value in metric[:, 0])
    return tables, (
        (
            "The measured frame does not agree with c = 50 mm: a sensor of 5 mm would see 90 "
            "mm at 1 "
            f"m, and the frame is wider. Calibrated, c is {distances} mm. So the generated "
            "readings "
            "of Tests 5.5 and 5.6 reach far beyond the sensor (Figure 5.11)."
        ),
        (
            "X0, Y0, Z0 of the metric camera is the point of its lens's axis nearest the world's "
            "origin, L4 .. L6 its viewing direction: of the eleven, four are a choice, not a "
            "measurement (table-5.12)."
        ),
    )


def _table_5_11() -> Worked:
    start, end = parameters("5.11"), parameters("5.12")
    inside = (end >= start - 1e-9) & (end <= start + 500 * STEPS + 1e-9)
    counted = (end - start) / STEPS
    rows: list[tuple[Cell, ...]] = [
        (name, float(STEPS[index]), *(float(counted[k, index]) for k in range(4)))
        for index, name in enumerate(PARAMETER_ORDER)
    ]
    outside = [
        f"{PARAMETER_ORDER[index]} of sensor {k + 1}" for k, index in np.argwhere(~inside).tolist()
    ]
    tables = (
        coefficient_table("coefficients, mm", {"Table 5.11": start}),
        ResultTable(
            "steps from Table 5.11 to Table 5.12, of 500",
            ("", "step of one iteration", *SENSORS),
            tuple(rows),
        ),
        error_table({"Table 5.11": start, "Table 5.11, sensor 2 mirrored": mirrored_start()}),
    )
    return tables, (
        (
            "The steps are not printed. The digits of Table 5.12 show them (c moves by 0.2 mm, X0 "
            "and Y0 by 0.1, Z0 by 1), and 500 of them take each range once around Table 5.10."
        ),
        (
            f"Out of its range lies {', '.join(outside)}: with all other digits in place, "
            "Table 5.11 "
            "must have had -1.25 there, the mirrored sensor. The optimisation is run from that."
        ),
    )


def _table_5_12() -> Worked:
    ours = stepwise()
    ended = np.array([_flat(bundle.parameters) for bundle in ours])
    passes = (0, 1, 2, 5, THESIS_SWEEPS)
    longer = stepwise(LONG_PASSES)
    error = np.array([[bundle.error[p] for bundle in ours] for p in passes])
    late = np.array([[bundle.error[-1] for bundle in longer]])
    thesis = np.array([[error_mm2(parameters("5.12")[k], k) for k in range(4)]])
    least = np.array([[error_mm2(metric_coefficients()[k], k) for k in range(4)]])
    errors = ResultTable(
        "E of [5.28] on the measured readings of the frame at 1 m (Test 5.4), mm^2",
        ("", *SENSORS),
        tuple(
            labelled_rows(
                (
                    "thesis, Table 5.12",
                    *(f"stepwise, after {p} of 13 steps" for p in passes),
                    f"stepwise, after {LONG_PASSES}",
                    "metric, the minimum",
                ),
                np.vstack([thesis, error, late, least]),
            )
        ),
    )
    at = ResultTable(
        "iteration of each coefficient's minimum in the last step, of 500",
        ("", *SENSORS),
        tuple(labelled_rows(PARAMETER_ORDER, np.array([bundle.at_iteration for bundle in ours]).T)),
    )
    flat = ResultTable(
        "singular values of the readings' slopes by the eleven coefficients, over the largest",
        ("", *SENSORS),
        tuple(
            labelled_rows(
                tuple(str(k + 1) for k in range(len(PARAMETER_ORDER))),
                np.array([free_directions(k) for k in range(4)]).T,
            )
        ),
    )
    ratio = (late / least)[0]
    tables = (
        coefficient_table(
            "coefficients, mm", {"Table 5.12": parameters("5.12"), "stepwise": ended}
        ),
        errors,
        at,
        flat,
    )
    return tables, (
        (
            'The text names "the pixel data from Test 5.6"; the printed coefficients fit the '
            "measured readings of the frame at 1 m, Test 5.4, and miss the generated ones of "
            "Test 5.6 by "
            "hundreds of mm^2: Test 5.4 is meant."
        ),
        (
            "Four of the eleven singular values are zero but for rounding: the scale of L1 .. L6, "
            "that of L1 .. L3 against c, L1 .. L3 plus k times L4 .. L6 against p0, and a "
            "shift of X0 "
            "along the lens's axis change no reading. Along them E is flat, every point of a "
            "space of "
            "four dimensions is a minimum, and none is reached at the same iteration as another: "
            "that was no sign of a local minimum."
        ),
        "What the steps end in is none either: one coefficient at a time crawls along the narrow "
        f"valley of the other seven. After {LONG_PASSES} steps E is still "
        + ", ".join(f"{value:.0f}" for value in ratio)
        + " times the minimum, which the metric search finds in milliseconds.",
    )


def _flat(of: CollinearityParameters) -> list[float]:
    return [of.c, of.p0, *of.centre_mm, *of.along, *of.axis]


def _table_5_13() -> Worked:
    found = {
        row["parameter"]: [float(row[f"sensor{k}"]) for k in range(1, 5)]
        for row in csv_rows("chapter_5_optimisation.csv")
        if row["table"] == "5.13"
    }
    set_up = parameters("5.10").copy()
    set_up[1, PARAMETER_ORDER.index("L1")] = -1.0
    principal, error = _best_p0(set_up)
    best = [_best_c_p0(set_up[k], k) for k in range(4)]
    rows: list[tuple[Cell, ...]] = [
        ("p0, thesis", *found["p0"]),
        ("p0 alone, Table 5.10 otherwise", *principal),
        ("p0 with c", *(one[1] for one in best)),
        ("c with p0", *(one[0] for one in best)),
    ]
    errors: list[tuple[Cell, ...]] = [
        ("thesis", *found["error"]),
        ("p0 alone, Table 5.10 otherwise", *error),
        ("p0 with c", *(one[2] for one in best)),
    ]
    return (
        ResultTable("principal point and distance, mm", ("", *SENSORS), tuple(rows)),
        ResultTable(
            "E of [5.28] on the measured readings of the frame at 1 m, mm^2",
            ("", *SENSORS),
            tuple(errors),
        ),
    ), (
        (
            "With c = 50 mm no p0 comes near the printed errors. With c free as well, sensors "
            "1 and 2 "
            "give the printed error and p0 to the last digit but one at "
            f"c = {best[0][0]:.2f} and {best[1][0]:.2f} mm (sensor 2 mirrored): the "
            "optimisation had "
            "the real lens, not Table 5.10's."
        ),
        (
            "Sensors 3 and 4 do not: with the angles of Table 5.10 their least errors are "
            f"{best[2][2]:.2f} and {best[3][2]:.2f} mm^2, below the printed 0.89 and 0.96."
        ),
    )


def _best_p0(values: Array) -> tuple[list[float], list[float]]:
    """Return for each sensor the p0 of least error, the rest held, and that error."""
    principal, error = [], []
    for k in range(4):
        base = values[k].copy()
        base[1] = 0.0
        # E is quadratic in p0: the mean difference is where it is least.
        principal.append(
            float(
                (
                    frame().readings_mm[:, k] - project_eleven_parameters(base, frame().points_mm)
                ).mean()
            )
        )
        base[1] = principal[-1]
        error.append(float(error_mm2(base, k)))
    return principal, error


def _best_c_p0(values: Array, sensor: int) -> tuple[float, float, float]:
    """Return c, p0 of least error with the rest held, and that error: linear in both."""
    unit = values.copy()
    unit[:2] = 1.0, 0.0
    design = np.column_stack(
        [project_eleven_parameters(unit, frame().points_mm), np.ones(len(frame().points_mm))]
    )
    c, p0 = np.linalg.lstsq(design, frame().readings_mm[:, sensor], rcond=None)[0].tolist()
    return c, p0, float(error_mm2(np.array([c, p0, *values[2:]]), sensor))


def _table_5_14() -> Worked:
    cameras = [from_array(row) for row in parameters("5.12")]
    points = frame().points_mm
    columns = {column.label: column for column in generated_columns(
        cameras, points, points, LONG_DFW_V500
    )}  # fmt: skip
    tables = (
        *statistics_tables(
            "by DLT",
            {
                "thesis": printed("5.14", "DLT"),
                **{label: of_column(columns[label]) for label in (AS_PUBLISHED, NORMALISED)},
            },
        ),
        *statistics_tables(
            "by known cameras, and by the metric calibration",
            {
                "thesis, BA": printed("5.14", "BA"),
                **{label: of_column(columns[label]) for label in (KNOWN_CAMERAS, METRIC)},
            },
        ),
    )
    own = metric_models()
    rms = [
        float(np.sqrt(error_mm2(parameters("5.12")[k], k) / len(points))) / DFW_V500[k].pitch_mm
        for k in range(4)
    ]
    return tables, (
        "The readings here are generated with the coefficients of Table 5.12 and reconstructed "
        "with the same cameras: the errors are those of the arithmetic, and say nothing of how "
        "well the coefficients describe the sensors. Against the measured readings they are off "
        f"by {', '.join(f'{value:.1f}' for value in rms)} px RMS, the metric cameras by "
        + ", ".join(f"{value:.1f}" for value in _metric_rms(own))
        + ".",
    )


def _metric_rms(models: tuple[SensorModel, ...]) -> list[float]:
    return [
        float(np.sqrt(error_mm2(metric_coefficients()[k], k) / len(frame().points_mm)))
        / DFW_V500[k].pitch_mm
        for k in range(len(models))
    ]


def _case(number: str, title: str, compute_tables: Callable[[], Worked]) -> TablesCase:
    return TablesCase(f"table-{number}", title, f"section 5.6, Table {number}", compute_tables)


TABLE_5_10: Final = _case("5.10", "the sensors as set up before the frame", _table_5_10)
TABLE_5_11: Final = _case("5.11", "where the optimisation started, and its steps", _table_5_11)
TABLE_5_12: Final = _case("5.12", "the optimisation of eleven coefficients", _table_5_12)
TABLE_5_13: Final = _case("5.13", "the optimisation of the principal point alone", _table_5_13)
TABLE_5_14: Final = _case(
    "5.14", "the frame from readings that the optimised sensors generate", _table_5_14
)
