"""Diagnosis: weak parameters, coverage, suggestions; cross-validation by points and blocks."""

import numpy as np
import pytest

from compute.calibration.assessment.assess import (
    block_count,
    calibrate_and_assess,
    cross_validate,
    spatial_block_index,
)
from compute.calibration.assessment.diagnosis import diagnose
from compute.calibration.calibrate import calibrate
from compute.calibration.settings import CalibrationSettings
from compute.errors import InvalidParameter
from tests.compute.rig import control_points, geometry, project, rig

SIGMA = 0.2


def test_a_suggestion_does_what_it_says() -> None:
    """The deviation over the volume that is foretold is what a calibration with the point has."""
    models, points = rig(), control_points(14)
    readings = project(models, points)
    sigma = np.full(readings.shape, SIGMA)
    before = diagnose(calibrate(points, readings, geometry(models), sigma), points, readings)
    assert before.mean_sigma_mm is not None
    assert len(before.suggestions) > 1
    for one in (before.suggestions[0], before.suggestions[-1]):
        more = np.vstack([points, one.position_mm])
        read = project(models, more)
        again = calibrate(more, read, geometry(models), np.full(read.shape, SIGMA))
        # Judged over the same volume: the box of the points from before.
        after = diagnose(again, np.vstack([points]), readings)
        assert after.mean_sigma_mm == pytest.approx(one.mean_sigma_mm, rel=1e-3)
        assert after.max_sigma_mm == pytest.approx(one.max_sigma_mm, rel=1e-3)
        assert one.mean_sigma_mm < before.mean_sigma_mm
    means = [one.mean_sigma_mm for one in before.suggestions]
    assert means == sorted(means)


def test_a_shallow_frame_confuses_distance_and_principal_distance() -> None:
    models, points = rig(), control_points(40)
    points[:, 2] = 1500.0 + 0.05 * (points[:, 2] - 1500.0)
    readings = project(models, points) + 0.01 * np.random.default_rng(0).standard_normal((40, 4))
    said = diagnose(calibrate(points, readings, geometry(models)), points, readings)
    for one in said.sensors:
        assert {name for name, _ in one.weakest[:4]} & {"principal_distance_px", "offset_z_mm"}
        assert one.depth_mm[1] - one.depth_mm[0] < 0.2 * one.depth_mm[0]
    deep = diagnose(
        calibrate(control_points(40), project(models, control_points(40)), geometry(models)),
        control_points(40),
        project(models, control_points(40)),
    )
    assert min(one.condition for one in deep.sensors) > max(s.condition for s in said.sensors)


def test_coverage_is_that_of_the_readings() -> None:
    models, points = rig(), control_points(30)
    readings = project(models, points)
    readings[readings > 1300.0] = np.nan
    said = diagnose(calibrate(points, readings, geometry(models)), points, readings)
    for one, column in zip(said.sensors, readings.T, strict=True):
        assert one.pixels == (np.nanmin(column), np.nanmax(column))
        assert one.pixel_share == pytest.approx(np.ptp(column[np.isfinite(column)]) / 2048)
    assert any("extrapolation" in remark for remark in said.remarks)


@pytest.mark.parametrize(("points", "count"), [(7, 5), (19, 6), (300, 16), (3, 3)])
def test_blocks_are_of_one_size_and_together(points: int, count: int) -> None:
    assert block_count(points) == count
    places = control_points(points)
    blocks = spatial_block_index(places, count)
    sizes = np.bincount(blocks, minlength=count)
    assert sizes.sum() == points
    assert np.ptp(sizes) <= 2
    spread = np.mean([places[blocks == b].std(axis=0).mean() for b in range(count)])
    assert spread < places.std(axis=0).mean()


def test_blocks_are_harder_than_points_and_both_are_in_the_whole() -> None:
    models, points = rig(), control_points(19)
    rng = np.random.default_rng(4)
    readings = project(models, points) + rng.standard_normal((19, 4))
    stages: list[tuple[float, str]] = []
    found = calibrate_and_assess(
        points,
        readings,
        geometry(models),
        None,
        CalibrationSettings(labels="report"),
        lambda done, stage: stages.append((done, stage)),
    )
    by_points, by_blocks = found.cross_validation
    assert (by_points.scheme, by_points.groups) == ("points", 19)
    assert (by_blocks.scheme, by_blocks.groups) == ("blocks", 6)
    calibration = calibrate(points, readings, geometry(models))
    by_point = cross_validate(calibration, points, readings, geometry(models), scheme="points")
    assert np.allclose(by_points.differences_mm, by_point.differences_mm)
    for fit, rms in zip(found.sensors, by_points.reading_rms_px, strict=True):
        assert rms is not None
        assert rms > fit.rms_px
    assert found.diagnosis is not None
    fractions = [done for done, _ in stages]
    assert fractions == sorted(fractions)
    assert fractions[0] == 0.0
    assert fractions[-1] <= 1.0


class Cancelled(Exception):
    pass


def test_what_progress_raises_ends_the_run() -> None:
    models, points = rig(), control_points(19)
    readings = project(models, points)

    def cancel(done: float, stage: str) -> None:
        if done > 0.6:
            raise Cancelled(stage)

    with pytest.raises(Cancelled, match="cross-validation"):
        calibrate_and_assess(points, readings, geometry(models), progress=cancel)


def test_only_what_control_points_made_is_cross_validated_by_them() -> None:
    from dataclasses import replace

    models, points = rig(), control_points(19)
    readings = project(models, points)
    found = replace(calibrate(points, readings, geometry(models)), method="update")
    with pytest.raises(InvalidParameter, match="update"):
        cross_validate(found, points, readings, geometry(models))


def test_a_robust_run_leaves_its_outliers_out_of_the_checks() -> None:
    models, points = rig(), control_points(30)
    readings = project(models, points) + 0.1 * np.random.default_rng(1).standard_normal((30, 4))
    readings[4, 2] += 60.0
    given = points, readings, geometry(models)
    found = calibrate(*given, settings=CalibrationSettings(loss="robust"))
    checked = cross_validate(found, *given, scheme="points")
    assert all(rms is not None and rms < 0.5 for rms in checked.reading_rms_px)


@pytest.mark.parametrize(("count", "said"), [(15, True), (24, False)])
def test_too_few_readings_for_a_robust_loss_with_terms_are_named(count: int, said: bool) -> None:
    models, points = rig(), control_points(count)
    noise = 0.1 * np.random.default_rng(2).standard_normal((count, 4))
    readings = project(models, points) + noise
    settings = CalibrationSettings(distortion="symmetric-3", loss="robust")
    found = calibrate(points, readings, geometry(models), settings=settings)
    remarks = " ".join(diagnose(found, points, readings).remarks)
    assert ("cannot always tell wrong readings" in remarks) == said
