"""Tables 5.1 to 5.4: simulated points before four linear sensors, and before two detectors."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.calibration.result import AxisErrors
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.reconstruction.triangulation import reconstruct, triangulate_linear
from validation.result_tables import Cell, ResultTable, TablesCase
from validation.table_5.error_statistics import of_column, printed, statistics_of, statistics_tables
from validation.table_5.twelve_points import (
    detector,
    lever_mm,
    noise_px,
    rotated,
    set_up,
    twelve_points,
)
from validation.tests_5_1_to_5_8 import AS_PUBLISHED, CASES, LEAVE_ONE_OUT, METRIC
from validation.thesis_data import LINEAR_CCD, csv_rows, load_test
from validation.thesis_methods.dlt import dlt_parameters_of, model_from_matrix
from validation.thesis_methods.iterative_dlt import iterative_dlt

Array = NDArray[np.float64]
Worked = tuple[tuple[ResultTable, ...], tuple[str, ...]]

REPEATS: Final = 40
SEED: Final = 54
BETWEEN_DETECTORS_DEG: Final = 60.0
OURS: Final = "ours, metric"


def _table_5_1() -> Worked:
    result = CASES["test-5.1"].run()
    columns = {
        "thesis": printed("5.1", "12 points"),
        **{
            label: of_column(result.column(label))
            for label in (AS_PUBLISHED, METRIC, LEAVE_ONE_OUT)
        },
    }
    tables = [*statistics_tables("12 points", columns)]
    for data_set, known, expected in (
        ("40 points", _diagonals(), _lines()),
        ("8 corners", _corners(), _corners()),
    ):
        ours = _simulated(detector(), known, expected)
        tables += statistics_tables(data_set, {"thesis": printed("5.1", data_set), OURS: ours})
    return tuple(tables), (
        (
            "The 12 points and their readings are printed (Appendix F). "
            f"Residuals of the metric calibration speak of {noise_px():.2f} px a reading."
        ),
        (
            "The other two sets are not printed. Ours are simulated: the cameras and "
            "the noise of the 12 points, the places as the text has them: 40 points on lines "
            "in 10 x 75 "
            "x 70 mm at 1,500 mm, after a calibration with 200 points on the diagonals of a "
            "cube of "
            f"500 mm; the corners of that cube, calibrated by themselves; means of {REPEATS} "
            "repeats."
        ),
        (
            "Eight points leave one reading a sensor to spare: their own errors show little of the "
            "calibration's."
        ),
    )


def _cube() -> Array:
    return np.asarray(twelve_points().points_mm.mean(axis=0))


def _corners() -> Array:
    """Corners of a cube of 500 mm, a little off their grid: seen along its edges they coincide."""
    rng = np.random.default_rng(SEED)
    corners = np.stack(np.meshgrid(*[(-250.0, 250.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(_cube() + corners + rng.uniform(-25.0, 25.0, (8, 3)))


def _diagonals() -> Array:
    share = np.linspace(-250.0, 250.0, 50)[:, None]
    directions = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1]], dtype=np.float64)
    return np.vstack([_cube() + share * direction for direction in directions])


def _lines() -> Array:
    share = np.linspace(-0.5, 0.5, 20)[:, None]
    size = np.array([10.0, 75.0, 70.0])
    rising, falling = size * np.array([1.0, 1.0, 1.0]), size * np.array([1.0, 1.0, -1.0])
    centre = np.array([-1500.0, 0.0, 0.0])
    return np.vstack([centre + share * rising, centre + share * falling])


def _simulated(models: tuple[SensorModel, ...], known_mm: Array, wanted_mm: Array) -> Array:
    """Calibrate with noisy readings of points, reconstruct others; mean statistics (5, 3)."""
    rng = np.random.default_rng(SEED)
    geometry = [SensorGeometry(model.name, 10**5) for model in models]
    cameras = CameraStack.of(models)
    centre = 5e4  # The text's volumes reach past the sensors' ends; no reading is cut off here.
    sigma = noise_px()
    same = known_mm is wanted_mm or np.array_equal(known_mm, wanted_mm)
    found = []
    for _ in range(REPEATS):
        known = cameras.project(known_mm) + centre
        known = known + sigma * rng.standard_normal(known.shape)
        expected = cameras.project(wanted_mm) + centre
        expected = known if same else expected + sigma * rng.standard_normal(expected.shape)
        calibration = calibrate(known_mm, known, geometry, np.full(known.shape, sigma))
        position = reconstruct(
            calibration.models, expected, np.full(expected.shape, sigma)
        ).position_mm
        found.append(statistics_of(AxisErrors.of(position - wanted_mm)))
    return np.asarray(np.mean(found, axis=0))


def _table_5_2() -> Worked:
    data = twelve_points()
    result = CASES["test-5.1"].run()
    without = []
    for k, scale in enumerate(LINEAR_CCD):
        fit = iterative_dlt(data.points_mm, data.readings_px[:, k], scale.name, 1, normalised=True)
        without.append(model_from_matrix(fit.matrix, scale.geometry, data.points_mm.mean(axis=0)))
    errors = AxisErrors.of(
        triangulate_linear(CameraStack.of(without), data.readings_px) - data.points_mm
    )
    columns = {
        "thesis, without": printed("5.2", "without compensation"),
        "thesis, with": printed("5.2", "with compensation"),
        "DLT, no distortion": statistics_of(errors),
        AS_PUBLISHED: of_column(result.column(AS_PUBLISHED)),
        METRIC: of_column(result.column(METRIC)),
    }
    return statistics_tables("12 points", columns), (
        (
            "The correction coefficients of the thesis's second half are not printed. Ours are "
            "what "
            "the 12 points allow: no distortion term, the cubic term [5.2], the metric camera."
        ),
        (
            f"A pixel is {1e3 * LINEAR_CCD[0].pitch_mm:.0f} um and readings are printed to 10 um: "
            "rounding and centroids, not the distortion, decide these millimetres of depth, "
            "which is "
            "why compensation changed little."
        ),
    )


def _table_5_3() -> Worked:
    data = twelve_points()
    names = [f"L{k}" for k in range(1, 8)]
    in_mm = LINEAR_CCD[0].pitch_mm
    calibration = calibrate(data.points_mm, data.readings_px, data.sensors)
    ours = [_in_mm(dlt_parameters_of(model), in_mm) for model in calibration.models]
    undetermined = sum(_without_dlt(model) for model in set_up())
    table = {row["parameter"]: [float(row[f"sensor{k}"]) for k in range(1, 5)]
             for row in csv_rows("table_5_3_dlt.csv")}  # fmt: skip
    thesis = np.array([table[name] for name in names]).T
    rows: list[tuple[Cell, ...]] = [
        (name, f"{k + 1}", float(thesis[k, row]), float(ours[k][row]))
        for row, name in enumerate(names)
        for k in range(4)
    ]
    derived: list[tuple[Cell, ...]] = []
    for k in range(4):
        for label, values in (("thesis", thesis[k]), (OURS, ours[k])):
            first, second = values[:3], values[4:]
            depth = 1.0 / float(np.linalg.norm(second))
            p0 = float(first @ second / (second @ second))
            along = first - p0 * second
            c = float(np.linalg.norm(along)) * depth
            derived.append((f"{k + 1}, {label}", p0, c, depth))
    return (
        ResultTable(
            "L1 .. L7 of [5.1], readings in mm", ("", "sensor", "thesis", OURS), tuple(rows)
        ),
        ResultTable(
            "what they say of the camera, mm",
            ("sensor", "p0 [5.3]", "principal distance", "depth of the world's origin"),
            tuple(derived),
        ),
    ), (
        (
            "All seven are divided by the depth of the world's origin from the lens, which is "
            "nearly "
            f"zero: with the cameras as set up (Test 5.2) {undetermined} of 4 sensors have it at "
            "zero exactly and no L at all. The scale of the printed numbers is that of a small "
            "difference; only their ratios mean something, and these are in the second table."
        ),
        (
            "The text takes |L4| for a distance to the principal point; it is the reading of the "
            "world's origin, and p0 is what [5.3] gives."
        ),
    )


def _without_dlt(model: SensorModel) -> bool:
    try:
        dlt_parameters_of(model)
    except InvalidParameter:
        return True
    return False


def _in_mm(parameters: Array, pitch_mm: float) -> Array:
    """Return L1..L7 for readings in mm from the sensor's edge instead of pixels."""
    first = (parameters[:4] + 0.5 * np.append(parameters[4:], 1.0)) * pitch_mm
    return np.concatenate([first, parameters[4:]])


def _table_5_4() -> Worked:
    points = twelve_points().points_mm
    one = detector()
    centre = points.mean(axis=0)
    other = tuple(rotated(m, f"{m.name}, second", BETWEEN_DETECTORS_DEG, centre) for m in one)
    single, both = _simulated(one, points, points), _simulated((*one, *other), points, points)
    columns = {
        "thesis, one": printed("5.1", "12 points"),
        "thesis, two": printed("5.4", "two detectors"),
        "ours, one": single,
        "ours, two": both,
    }
    gain = np.linalg.norm(single[1]) / np.linalg.norm(both[1])
    theirs = np.linalg.norm(printed("5.1", "12 points")[1]) / np.linalg.norm(
        printed("5.4", "two detectors")[1]
    )
    return statistics_tables("12 points from one and from two detectors", columns), (
        (
            "The second detector's readings are not printed. Simulated: the cameras of Test "
            "5.1, and "
            f"the same turned by {BETWEEN_DETECTORS_DEG:g} deg about the vertical through the "
            "middle "
            f"of the points; noise {noise_px():.2f} px, that of Test 5.1; calibrated and "
            f"reconstructed with the same 12 points, means of {REPEATS} repeats."
        ),
        (
            f"The second detector lowers the standard deviation {gain:.1f} times here and "
            f"{theirs:.1f} times in the thesis: one detector's depth is the other's width."
        ),
        "Test 5.2 turned sensors 3 and 4 to the other diagonal: by point 1 their lenses lie "
        + " and ".join(f"{abs(x):.0f}" for x in lever_mm(load_test("5.1").readings_mm[0])[2:])
        + " mm off the middle along what they measure in Test 5.1, and "
        + " and ".join(f"{abs(x):.0f}" for x in lever_mm(load_test("5.2").readings_mm[0])[2:])
        + " mm in Test 5.2, which loses most of the depth. So the cameras here are those of "
        "Test 5.1.",
    )


TABLE_5_1: Final = TablesCase(
    "table-5.1", "12, 40 and 8 simulated points, four linear CCDs", "section 5.2, Table 5.1",
    _table_5_1,
)  # fmt: skip
TABLE_5_2: Final = TablesCase(
    "table-5.2", "the 12 points with and without distortion compensated",
    "section 5.2, Table 5.2", _table_5_2,
)  # fmt: skip
TABLE_5_3: Final = TablesCase(
    "table-5.3", "the DLT parameters of the 12 points", "section 5.2, Table 5.3", _table_5_3
)
TABLE_5_4: Final = TablesCase(
    "table-5.4", "two detectors at 60 deg", "section 5.2, Table 5.4", _table_5_4
)
