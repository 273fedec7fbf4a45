"""The thesis's stepwise optimisation: its steps, its gauge, and where it ends."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.calibration.calibrate import calibrate
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter, NoConvergence
from tests.compute.rig import control_points, geometry, project, rig
from validation.thesis_methods.dlt import collinearity_parameters_of, model_from_collinearity
from validation.thesis_methods.eleven_parameter_bundle import (
    PARAMETER_ORDER,
    StepGrid,
    from_array,
    project_eleven_parameters,
    stepwise_bundle,
    to_array,
)

POINTS = control_points(24)
MODELS = rig()
READINGS = project(MODELS, POINTS)
SENSORS = geometry(MODELS)


def test_generated_readings_are_the_cameras() -> None:
    for k, model in enumerate(MODELS):
        values = to_array(collinearity_parameters_of(model))
        np.testing.assert_allclose(
            project_eleven_parameters(values, POINTS), READINGS[:, k], atol=1e-8
        )
        back = model_from_collinearity(from_array(values), SENSORS[k])
        np.testing.assert_allclose(
            CameraStack.of([back]).project(POINTS)[:, 0], READINGS[:, k], atol=1e-8
        )


@settings(max_examples=30, deadline=None)
@given(
    st.floats(0.2, 5.0), st.floats(0.2, 5.0), st.floats(-2.0, 2.0), st.floats(-500.0, 500.0),
    st.integers(0, 3),
)  # fmt: skip
def test_four_changes_of_the_eleven_change_no_reading(
    common: float, first: float, shear: float, along_axis: float, k: int
) -> None:
    """The gauge that the optimisation of section 5.6 does not fix."""
    of = to_array(collinearity_parameters_of(MODELS[k]))
    c, p0, centre, along, axis = of[0], of[1], of[2:5], of[5:8], of[8:11]
    moved = centre + along_axis * np.cross(along, axis)
    # p = p0 - c l.r / m.r: l + k m adds c k, which p0 takes up; l may be larger as c is smaller.
    sheared = along + shear * axis
    changed = np.array(
        [c / first, p0 + c * shear, *moved, *(common * first * sheared), *(common * axis)]
    )
    np.testing.assert_allclose(
        project_eleven_parameters(changed, POINTS), READINGS[:, k], atol=1e-6
    )


def test_a_pass_never_makes_it_worse_and_stays_on_its_grid() -> None:
    estimate = collinearity_parameters_of(MODELS[1])
    grid = StepGrid.around(estimate, SENSORS[1])
    found = stepwise_bundle(POINTS, READINGS[:, 1], "s2", grid, passes=4)
    assert len(found.error) == 5
    assert (np.diff(found.error) <= 0.0).all()
    assert found.error[-1] < found.error[0] / 10.0
    steps = (to_array(found.parameters) - grid.first) / grid.step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert ((steps > -0.5) & (steps < grid.iterations + 0.5)).all()
    assert (found.at_iteration >= 0).all()
    assert (found.at_iteration <= grid.iterations).all()


def test_one_coefficient_is_found_where_only_it_is_wrong() -> None:
    estimate = to_array(collinearity_parameters_of(MODELS[2]))
    index = PARAMETER_ORDER.index("p0")
    first, step = estimate.copy(), np.zeros(len(PARAMETER_ORDER))
    first[index] -= 40.0
    step[index] = 0.5
    found = stepwise_bundle(POINTS, READINGS[:, 2], "s3", StepGrid(first, step, 200), passes=1)
    assert found.at_iteration[index] == 80
    assert found.error[-1] < 1e-12


def test_the_grid_takes_the_estimate_in() -> None:
    estimate = collinearity_parameters_of(MODELS[0])
    grid = StepGrid.around(estimate, SENSORS[0])
    last = grid.first + grid.iterations * grid.step
    assert ((grid.first < to_array(estimate)) & (to_array(estimate) < last)).all()


def test_it_misses_the_minimum() -> None:
    noisy = READINGS + np.random.default_rng(5).standard_normal(READINGS.shape)
    metric = calibrate(POINTS, noisy, SENSORS)
    for k, (ours, model) in enumerate(zip(metric.sensors, MODELS, strict=True)):
        grid = StepGrid.around(collinearity_parameters_of(model), SENSORS[k])
        found = stepwise_bundle(POINTS, noisy[:, k], SENSORS[k].name, grid)
        rms_px = float(np.sqrt(found.error[-1] / len(POINTS)))
        assert rms_px > 1.05 * ours.rms_px
        assert rms_px < 200.0  # of 2048: it does end near a camera


def test_bad_input_is_refused() -> None:
    estimate = to_array(collinearity_parameters_of(MODELS[0]))
    with pytest.raises(InvalidParameter, match="s1"):
        stepwise_bundle(POINTS, READINGS[:, 0], "s1", StepGrid(estimate, estimate * np.nan))
    with pytest.raises(InvalidParameter, match="0 iterations"):
        stepwise_bundle(POINTS, READINGS[:, 0], "s1", StepGrid(estimate, estimate, 0))
    # All coefficients zero: no camera.
    nothing = StepGrid(np.zeros(11), np.zeros(11), 1)
    with pytest.raises(NoConvergence, match="no value"):
        stepwise_bundle(POINTS, READINGS[:, 0], "s1", nothing)
