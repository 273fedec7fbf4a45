"""The measured frame at 1 m and its use in section 5.6, for Tables 5.10 to 5.14."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.camera.model import SensorModel
from validation.thesis_data import DFW_V500, csv_rows, load_test
from validation.thesis_methods.dlt import collinearity_parameters_of
from validation.thesis_methods.eleven_parameter_bundle import (
    PARAMETER_ORDER,
    THESIS_SWEEPS,
    StepGrid,
    StepwiseBundle,
    project_eleven_parameters,
    stepwise_bundle,
)

Array = NDArray[np.float64]

SENSORS: Final = ("sensor 1", "sensor 2", "sensor 3", "sensor 4")
STEPS: Final = np.array([0.2, 0.01, 0.1, 0.1, 1.0, *[1e-3] * 6])
"""Of c, p0, X0, Y0, Z0 [mm] and L1 .. L6: the digits of Table 5.12."""


@dataclass(frozen=True, eq=False)
class Frame:
    """The frame at 1 m as measured (Test 5.4): points (19, 3) and readings (19, 4) [mm]."""

    points_mm: Array
    readings_mm: Array


@cache
def frame() -> Frame:
    """Load Test 5.4."""
    test = load_test("5.4")
    return Frame(test.points_mm, test.readings_mm)


@cache
def parameters(table: str) -> Array:
    """Return the coefficients of Table 5.10, 5.11 or 5.12, shape (4, 11)."""
    found = {
        row["parameter"]: [float(row[f"sensor{k}"]) for k in range(1, 5)]
        for row in csv_rows("chapter_5_optimisation.csv")
        if row["table"] == table
    }
    return np.array([found[name] for name in PARAMETER_ORDER]).T


def error_mm2(values: Array, sensor: int) -> Array:
    """Return E of [5.28] of coefficients (..., 11) on the measured readings, shape (...)."""
    found = project_eleven_parameters(values, frame().points_mm) - frame().readings_mm[:, sensor]
    return np.asarray((found**2).sum(axis=-1))


@cache
def metric_models() -> tuple[SensorModel, ...]:
    """Return the metric cameras of Test 5.4."""
    readings = np.column_stack(
        [scale.to_px(frame().readings_mm[:, k]) for k, scale in enumerate(DFW_V500)]
    )
    geometry = [scale.geometry for scale in DFW_V500]
    return calibrate(frame().points_mm, readings, geometry).models


@cache
def metric_coefficients() -> Array:
    """Return the metric cameras as eleven coefficients in mm, shape (4, 11)."""
    found = []
    for model, scale in zip(metric_models(), DFW_V500, strict=True):
        of = collinearity_parameters_of(model)
        c, p0 = of.c * scale.pitch_mm, scale.to_mm(of.p0)
        found.append([c, p0, *of.centre_mm, *of.along, *of.axis])
    return np.array(found)


def mirrored_start() -> Array:
    """Return Table 5.11 with sensor 2 turned as Table 5.12 has it, shape (4, 11).

    Table 5.12 gives sensor 2 L1 = -1, which no step from 0.75 to 1.25 reaches; from -1.25 it does.
    """
    start = parameters("5.11").copy()
    start[1, PARAMETER_ORDER.index("L1")] = -1.25
    return start


@cache
def stepwise(passes: int = THESIS_SWEEPS) -> tuple[StepwiseBundle, ...]:
    """Run the optimisation of Table 5.12 on the measured readings, from Table 5.11."""
    return tuple(
        stepwise_bundle(
            frame().points_mm,
            frame().readings_mm[:, k],
            SENSORS[k],
            StepGrid(start, STEPS),
            passes,
        )
        for k, start in enumerate(mirrored_start())
    )


def free_directions(sensor: int) -> Array:
    """Return the singular values of d readings / d (eleven coefficients), over the largest.

    At the metric camera, columns scaled to length 1, by central differences.
    """
    values = metric_coefficients()[sensor]
    columns = []
    for index in range(len(PARAMETER_ORDER)):
        step = np.zeros(len(PARAMETER_ORDER))
        step[index] = 1e-5 * max(1.0, abs(values[index]))
        ahead, behind = (
            project_eleven_parameters(values + s * step, frame().points_mm) for s in (1.0, -1.0)
        )
        columns.append((ahead - behind) / (2.0 * step[index]))
    jacobian = np.column_stack(columns)
    singular = np.linalg.svd(jacobian / np.linalg.norm(jacobian, axis=0), compute_uv=False)
    return np.asarray(singular / singular[0])
