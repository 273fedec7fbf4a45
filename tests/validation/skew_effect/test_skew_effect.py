"""Case skew-effect: distortion over both field angles, and the design's figures of it."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from compute.calibration.calibrate import calibrate
from compute.camera.model import SensorGeometry
from compute.camera.stack import CameraStack
from compute.optics.pixel_row import PixelRow
from compute.optics.stripe_optics.stripe_profile import Blur
from compute.optics.stripe_optics.traced_stripes import TracedStripes
from service.cli import app
from validation.aberrations.thesis_lens import ROW, WIDTH_MM, StopPlace, stopped_lens
from validation.all_cases import ALL_CASES
from validation.result_tables import TablesCase
from validation.skew_effect.case import MODELS, _axis_table, _index_table
from validation.skew_effect.traced_readings import (
    FIELD_U,
    FIELD_V,
    LONG_ROW,
    Readings,
    cube_points,
    device_sensors,
    field_points,
    fitted,
    left_out_px,
    other_field_points,
    traced_readings,
)

CAMERA, POWERS, _, BOTH, _ = MODELS.values()


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.fixture(scope="module")
def field() -> tuple[Readings, Readings]:
    assembly = stopped_lens(4.0)
    return (
        traced_readings(assembly, field_points((11, 7, 3))),
        traced_readings(assembly, other_field_points(120)),
    )


def test_the_designs_figures(field: tuple[Readings, Readings]) -> None:
    """3.1, 1.5 and 0.002 px: the first two within what sampling the field otherwise changes."""
    known, other = field
    for terms, design in ((CAMERA, 3.1), (POWERS, 1.5)):
        fit = fitted(stopped_lens(4.0), known, terms)
        assert fit.rms_px == pytest.approx(design, rel=0.2)
        assert rms(left_out_px(fit, other)) == pytest.approx(design, rel=0.2)
    fit = fitted(stopped_lens(4.0), known, BOTH)
    assert max(fit.rms_px, rms(left_out_px(fit, other))) < 0.002


def test_a_stop_on_the_curved_face_has_a_fraction_of_the_distortion(
    field: tuple[Readings, Readings],
) -> None:
    curved = stopped_lens(4.0, "on the curved face")
    known = traced_readings(curved, field_points((11, 7, 3)))
    assert (
        fitted(curved, known, CAMERA).rms_px
        < 0.2 * fitted(stopped_lens(4.0), field[0], CAMERA).rms_px
    )


def test_the_pure_camera_is_the_calibrations() -> None:
    """Model (a) leaves what the metric calibration of compute.calibration leaves."""
    assembly = stopped_lens(4.0)
    sensor = device_sensors(assembly)[2]
    known = traced_readings(assembly, sensor.to_sensor_frame(cube_points(4)))
    world = known.points_mm @ sensor.rotation + np.array(sensor.position_mm)
    found = calibrate(world, known.centroid_px[:, None], [SensorGeometry("one", ROW.count)])
    rest = known.centroid_px - CameraStack.of([found.sensors[0].model]).project(world)[:, 0]
    assert rms(rest) == pytest.approx(fitted(assembly, known, CAMERA).rms_px, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("width", "place"), [(WIDTH_MM, "on the plane face"), (4.0, "4 mm behind")]
)
def test_no_light_falls_beside_the_long_row(width: float, place: StopPlace) -> None:
    """The line that reaches farthest, in a corner: a row four times as long has no more."""
    corners = np.array([[FIELD_U, FIELD_V, 1.0]]) * 1000.0
    longer = PixelRow(4 * LONG_ROW.count, LONG_ROW.pitch_um, LONG_ROW.height_um)
    light, centroid = [], []
    for row in (ROW, LONG_ROW, longer):
        lines = TracedStripes(stopped_lens(width, place), row, Blur(None, 0.0)).shapes(corners)
        light.append(lines.total_sr)
        centroid.append(lines.centroid_px - row.centre_px)
    assert light[1] == pytest.approx(light[2], rel=1e-9, abs=0.0)
    assert centroid[1] == pytest.approx(centroid[2], abs=1e-6)
    # The short row loses what falls more than its own length beside it.
    assert (light[0] < 0.999 * light[1]).all()


@pytest.mark.slow
def test_without_a_stop_no_polynomial_follows_the_centroid() -> None:
    whole = stopped_lens(WIDTH_MM)
    known = traced_readings(whole, field_points((11, 7, 2)))
    left = [fitted(whole, known, terms).rms_px for terms in (CAMERA, POWERS, BOTH)]
    assert left[0] > left[1] > left[2] > 1.0


def test_v_is_measured_to_the_row() -> None:
    table = _axis_table()
    to_lens, to_row = (float(str(value)) for value in table.column("RMS")[2:])
    assert to_row < 0.002 < 10.0 * to_row < to_lens


def test_the_effective_index_is_the_tracers() -> None:
    table = _index_table()
    assert max(float(str(v)) for v in table.column("traced less in-plane, max [um]")) < 1e-9
    index = [float(str(value)) for value in table.column("index N")]
    assert index == sorted(index)


@pytest.mark.slow
def test_the_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case = ALL_CASES["skew-effect"]
    assert isinstance(case, TablesCase)
    assert case.picture is not None
    case.picture(tmp_path / "skew.png")
    assert (tmp_path / "skew.png").read_bytes().startswith(b"\x89PNG")


def test_output_is_for_cases_with_a_picture(tmp_path: Path) -> None:
    for words, said in ((["test-5.4"], "skew-effect"), (["all"], "skew-effect"), ([], "a case")):
        result = CliRunner().invoke(
            app, ["reproduce", *words, "--output", str(tmp_path / "none.png")]
        )
        assert result.exit_code == 2
        assert said in result.stderr
    assert not (tmp_path / "none.png").exists()
