import numpy as np
import pytest

from compute.camera.stack import CameraStack
from compute.mapping.build import build_table
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.result import MappingResult, MappingSettings
from compute.reconstruction.triangulation import reconstruct
from tests.compute.mapping.scenes import (
    SIGMA,
    calibrated,
    exact,
    lattice,
    measure,
    measured,
    places,
    truth,
)


def correction_errors(result: MappingResult, models, points):
    """Errors of corrections at points, shape (N, S), and their variances."""
    found = result.table.at(points)
    right = CameraStack.of(models).project(points) - exact(truth(), points)
    return found.value_px - right, found.variance_px2, found.inside


@pytest.fixture(scope="module")
def control():
    return measured(places(150, 1))


@pytest.fixture(scope="module")
def calibration(control):
    return calibrated(control)


@pytest.fixture(scope="module")
def built(control, calibration):
    return build_table(calibration.models, "hash", control)


@pytest.mark.slow
def test_the_table_takes_the_misfit_away(built, calibration):
    points = places(500, 2, share=0.85)
    errors, _, inside = correction_errors(built, calibration.models, points)
    right = CameraStack.of(calibration.models).project(points) - exact(truth(), points)
    before = np.sqrt((right**2).mean())
    assert before > 5.0 * SIGMA
    assert np.sqrt((errors[inside] ** 2).mean()) < 0.2 * before
    assert inside.mean() > 0.9
    assert built.table.calibration_hash == "hash"
    assert built.table.sensors == tuple(model.name for model in calibration.models)


@pytest.mark.slow
def test_variances_are_honest_on_points_never_seen():
    # Over several maps: the errors within one are all alike.
    squares = []
    for seed in range(4):
        control = measured(places(100, 10 + seed), seed)
        models = calibrated(control).models
        result = build_table(models, "", control)
        errors, variance, inside = correction_errors(result, models, places(200, 3, share=0.9))
        squares.append((errors**2 / variance)[inside].mean())
    assert 0.4 < np.mean(squares) < 1.4


@pytest.mark.slow
def test_variances_are_honest_where_noise_hides_the_misfit(monkeypatch):
    """How smooth the field is can hardly be told there, and that counts in the variance."""
    averaged, most_probable = [], []
    for seed in range(40, 45):
        control = measured(places(60, seed), seed, sigma=2.0)
        models, new = calibrated(control).models, places(200, seed + 20, share=0.9)
        for squares, min_share in ((averaged, 1e-3), (most_probable, 1.0)):
            monkeypatch.setattr("compute.mapping.penalty_selection.MIN_SHARE", min_share)
            result = build_table(models, "", control)
            error, variance, inside = correction_errors(result, models, new)
            squares += [np.mean((error**2 / variance)[inside[:, s], s]) for s in range(3)]
    # Of 15 sensors with about ten errors each: a deviation of 0.12.
    assert 0.6 < np.mean(averaged) < 1.35
    assert np.mean(most_probable) > 1.1 * np.mean(averaged)


@pytest.mark.slow
def test_deviations_that_are_too_small_are_noticed_and_no_map_follows_the_noise(calibration):
    points, new = places(100, 70), places(300, 71, share=0.9)
    readings = measure(points, 72)
    right = CameraStack.of(calibration.models).project(new) - exact(truth(), new)
    errors, squares = [], []
    for stated in (SIGMA, SIGMA / 4.0):
        control = MappingMeasurements(points, readings, np.full(readings.shape, stated))
        result = build_table(calibrated(control).models, "", control)
        error, variance, inside = correction_errors(result, calibrated(control).models, new)
        errors.append(np.sqrt((error[inside] ** 2).mean()))
        squares.append((error**2 / variance)[inside].mean())
        found = [sensor.noise_factor for sensor in result.validation.sensors]
        if stated == SIGMA:
            assert found == [1.0] * 3
        else:
            assert 9.0 < min(found) < max(found) < 25.0
        assert 0.3 < squares[-1] < 1.5
        assert max(sensor.normalised_squared_error for sensor in result.validation.sensors) < 1.6
    assert errors[1] < 1.2 * errors[0]
    assert errors[0] < 0.2 * np.sqrt((right**2).mean())


def test_mapped_points_carry_the_covariance_they_should(built, calibration):
    points = places(1000, 4, share=0.85)
    readings = measure(points, 6)
    sigma = np.full(readings.shape, SIGMA)
    found = reconstruct(calibration.models, readings, sigma, None, built.table)
    error = found.position_mm - points
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_mm2), error)
    assert 2.2 < square.mean() < 3.6
    without = reconstruct(calibration.models, readings, sigma)
    assert (error**2).sum() < 0.1 * ((without.position_mm - points) ** 2).sum()


@pytest.mark.slow
def test_where_nothing_is_to_be_corrected_the_map_stays_empty():
    """A seven-parameter device: the correction is the calibration's own error and no more."""
    points = places(80, 1)
    control = measured(points, strength=0.0)
    models = calibrated(control).models
    result = build_table(models, "", control)
    for sensor in result.validation.sensors:
        assert sensor.effective_parameters < 20.0
    found = result.table.at(places(300, 8, share=0.9))
    right = CameraStack.of(models).project(places(300, 8, share=0.9))
    right = right - exact(truth(0.0), places(300, 8, share=0.9))
    # What is left of the calibration's error cannot be told from its own measurements.
    assert 0.3 < ((found.value_px - right) ** 2 / found.variance_px2).mean() < 2.0


@pytest.mark.slow
def test_other_measurements_than_the_calibrations_correct_its_error():
    """A calibration from few noisy points, mapped with many good ones: its error goes away."""
    few = measured(places(25, 20), 21, sigma=1.0, strength=0.0)
    calibration = calibrated(few)
    many = measured(places(100, 22), 23, strength=0.0)
    result = build_table(calibration.models, "", many, np.array(calibration.covariance))
    points = places(300, 24, share=0.9)
    found = result.table.at(points)
    right = CameraStack.of(calibration.models).project(points) - exact(truth(0.0), points)
    before, after = np.sqrt((right**2).mean()), np.sqrt(((found.value_px - right) ** 2).mean())
    assert before > 0.2
    assert after < 0.1 * before
    assert 0.3 < ((found.value_px - right) ** 2 / found.variance_px2).mean() < 2.0


@pytest.mark.slow
def test_a_calibrations_error_is_weighed_alike_without_the_measurements_deviations():
    """A rough calibration and fine measurements: the deviation that they show is the weight."""
    calibration = calibrated(measured(places(12, 1), sigma=0.5, strength=0.0))
    fine, new = measured(places(60, 4), seed=8, sigma=0.02, strength=0.0), places(300, 6, 0.8)
    covariance = np.array(calibration.covariance)
    right = CameraStack.of(calibration.models).project(new) - exact(truth(0.0), new)
    errors, squares = [], []
    for sigma in (fine.sigma_px, None):
        what = MappingMeasurements(fine.points_mm, fine.readings_px, sigma)
        table = build_table(calibration.models, "h", what, covariance).table
        found = table.at(new)
        error = (found.value_px - right)[found.inside.all(axis=1)]
        errors.append(np.sqrt((error**2).mean()))
        squares.append((error**2 / found.variance_px2[found.inside.all(axis=1)]).mean())
    assert errors[0] < 0.02
    assert errors[1] < 1.3 * errors[0]
    # Of three sensors with seven errors each: 21 squares, a deviation of 0.3.
    assert min(squares) > 0.3
    assert max(squares) < 2.0


def test_validation_says_what_new_points_show(built, calibration):
    points = places(500, 2, share=0.95)
    errors, _, inside = correction_errors(built, calibration.models, points)
    for column, sensor in enumerate(built.validation.sensors):
        here = errors[inside[:, column], column]
        with_noise = np.hypot(np.sqrt((here**2).mean()), SIGMA)
        assert sensor.points == 150
        assert with_noise < 1.3 * sensor.left_out_rms_px
        assert sensor.left_out_rms_px < 3.0 * with_noise
        assert sensor.after_rms_px < sensor.left_out_rms_px < sensor.before_rms_px
        assert 0.5 < sensor.normalised_squared_error < 2.0
        assert sensor.noise_factor == 1.0
        assert sensor.sigma_px == pytest.approx(SIGMA)
        assert sensor.suspects == ()


@pytest.mark.slow
def test_deviations_that_are_not_given_are_estimated(control, calibration):
    unknown = MappingMeasurements(control.points_mm, control.readings_px)
    result = build_table(calibration.models, "", unknown)
    for sensor in result.validation.sensors:
        assert sensor.sigma_px == pytest.approx(SIGMA, rel=0.35)


def test_uncertain_places_count_as_noise_of_the_readings(control, calibration):
    """0.1 mm moves a reading by 0.2 px: four times the noise."""
    settings = MappingSettings(penalty_weight=1.0)
    uncertain = MappingMeasurements(control.points_mm, control.readings_px, control.sigma_px, 0.1)
    result = build_table(calibration.models, "", uncertain, settings=settings)
    slope = CameraStack.of(calibration.models).linearise(control.points_mm)[1]
    expected = np.sqrt(SIGMA**2 + 0.01 * (slope**2).sum(axis=2).mean(axis=0))
    found = [sensor.sigma_px for sensor in result.validation.sensors]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.slow
def test_a_wrong_measurement_is_named(control, calibration):
    readings = control.readings_px.copy()
    readings[17, 1] += 3.0
    wrong = MappingMeasurements(control.points_mm, readings, control.sigma_px)
    result = build_table(calibration.models, "", wrong)
    assert [len(sensor.suspects) > 0 for sensor in result.validation.sensors] == [
        False,
        True,
        False,
    ]
    worst = result.validation.sensors[1].suspects[0]
    assert worst.point == 17
    assert abs(worst.left_out_px) == pytest.approx(3.0, rel=0.3)


def test_smoother_maps_have_fewer_parameters(control, calibration):
    found = []
    for penalty_weight in (1e-3, 1.0, 1e3):
        result = build_table(
            calibration.models, "", control, settings=MappingSettings(penalty_weight=penalty_weight)
        )
        found.append(result.validation.sensors[0].effective_parameters)
    assert found[0] > found[1] > found[2]


def test_the_same_measurements_give_the_same_table(control, calibration):
    settings = MappingSettings(penalty_weight=0.1)
    built, again = (
        build_table(calibration.models, "", control, settings=settings) for _ in range(2)
    )
    np.testing.assert_array_equal(again.table.coefficients_px, built.table.coefficients_px)
    np.testing.assert_array_equal(again.table.variance_px2, built.table.variance_px2)


def test_outside_of_what_a_sensor_saw_nothing_is_supported(control, calibration):
    readings = control.readings_px.copy()
    readings[control.points_mm[:, 0] > 50.0, 0] = np.nan
    half = MappingMeasurements(control.points_mm, readings, control.sigma_px)
    result = build_table(calibration.models, "", half, settings=MappingSettings(penalty_weight=1.0))
    there = result.table.at(np.array([[150.0, 0.0, 1500.0], [-100.0, 0.0, 1500.0]]))
    assert there.inside.tolist() == [[False, True, True], [True, True, True]]


def test_progress_is_told_and_stops_the_run(control, calibration):
    told = []
    settings = MappingSettings()

    def progress(share: float, stage: str) -> None:
        told.append((share, stage))
        if len(told) == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_table(calibration.models, "", control, settings=settings, progress=progress)
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert shares[0] > 0.0
    assert shares[-1] < 1.0
    assert "s1" in told[0][1]


@pytest.mark.parametrize(("method", "degree"), [("trilinear", 1), ("tricubic", 3)])
def test_interpolation_goes_through_the_nodes(method, degree):
    points = lattice((6, 6, 4))
    control = measured(points)
    models = calibrated(control).models
    result = build_table(models, "", control, settings=MappingSettings(method=method))
    found = result.table.at(points)
    right = CameraStack.of(models).project(points) - control.readings_px
    np.testing.assert_allclose(found.value_px, right, atol=1e-9)
    np.testing.assert_allclose(found.variance_px2, SIGMA**2)
    assert result.table.degree == degree
    assert found.inside.all()
    assert result.table.grid.cells == (5, 5, 3)


def test_missing_nodes_at_the_rim_are_not_supported():
    points = lattice((6, 6, 4))
    control = measured(points)
    models = calibrated(control).models
    readings = control.readings_px.copy()
    corner = int(np.argmax((points == points.max(axis=0)).all(axis=1)))
    readings[corner, 0] = np.nan
    missing = MappingMeasurements(points, readings, control.sigma_px)
    for method, lost in (("trilinear", 1), ("tricubic", 8)):
        result = build_table(models, "", missing, settings=MappingSettings(method=method))
        assert (~result.table.valid[0]).sum() == lost
        assert result.table.valid[1:].all()
