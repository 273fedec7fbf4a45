"""The association kernel beside its definition, on whole scenes and on single frames."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.tracking.association import associate
from compute.tracking.motion_model import MotionModels, mix_and_predict
from compute.tracking.native.kernels import Associator
from compute.tracking.settings import TrackerSettings
from compute.tracking.state_initialisation import states_from_points
from compute.tracking.tracks import AssociationResult
from tests.compute.distorted_rig import distorted_rig
from tests.compute.measurement.test_measurement_model import table
from tests.compute.tracking.moving_markers import MIDDLE_MM, PIXELS, Sensing, peaks_of, ring

Array = NDArray[np.float64]

STEP_S = 0.01


def same(one: AssociationResult, two: AssociationResult) -> None:
    for name in ("peaks", "merged", "hypotheses_pruned", "in_view"):
        assert (getattr(one, name) == getattr(two, name)).all(), name
    for name in ("probability", "nis", "log_likelihood_ratio"):
        assert np.allclose(getattr(one, name), getattr(two, name), rtol=1e-7, atol=1e-7), name
    for name in ("mean", "covariance", "bias_cross_covariance", "probability"):
        first, second = getattr(one.states, name), getattr(two.states, name)
        assert np.allclose(first, second, rtol=1e-6, atol=1e-7), name


def compare(
    model: MeasurementModel,
    settings: TrackerSettings,
    markers: int,
    frames: int,
    seed: int,
) -> int:
    """Follow markers in a crowd with both, frame by frame; return how many peaks were shared."""
    rng = np.random.default_rng(seed)
    motion = MotionModels.of(settings)
    native = Associator(model, motion, settings)
    places = MIDDLE_MM + rng.uniform(-25.0, 25.0, (markers, 3))
    velocity = rng.uniform(-300.0, 300.0, (markers, 3))
    sigma = np.full((markers, len(model)), 0.05)
    merged = 0
    sensing = Sensing(missed=0.1, false_peaks=1.0, resolution_px=4.0)
    for frame in range(frames):
        if frame % 5 == 0:
            # Anew: in such a crowd tracks are soon elsewhere. Of their velocity something is known.
            states, bias = states_from_points(model, motion, settings, places, sigma)
            states.mean[..., 3:6] = velocity[:, None]
            states.covariance[..., 3:6, 3:6] *= 0.01
        places = places + STEP_S * velocity
        states = mix_and_predict(motion, states, np.full(markers, STEP_S))
        position, deviation, flags, _ = peaks_of(model.cameras, places, sensing, rng)
        if model.corrections is not None:
            # As the sensors give them: what the table adds is not there yet.
            position = position - model.corrections.at(MIDDLE_MM[None]).value_px[0][:, None]
        peaks = Measurements.of(position, deviation, flags)
        definition = associate(model, motion, settings, states, bias, peaks)
        same(definition, native.associate(states, bias, peaks))
        merged += int(definition.merged.sum())
        states = definition.states
    return merged


@pytest.mark.parametrize("motion", ["velocity", "acceleration", "interacting"])
def test_kernel_is_its_definition_in_a_crowd(motion: str) -> None:
    settings = TrackerSettings(motion=motion, jerk_psd=1e7)  # type: ignore[arg-type]
    model = MeasurementModel(CameraStack.of(ring()), pixels=(PIXELS,) * 4)
    assert compare(model, settings, 8, 25, seed=1) > 40


def test_kernel_is_its_definition_with_distortion_table_and_calibration() -> None:
    models = [
        replace(model, cubic_per_px2=2e-9) for model in distorted_rig(((2, 1), (0, 3), (3, 0)))
    ]
    cameras = CameraStack.of(models)
    rng = np.random.default_rng(3)
    count = int(cameras.parameter_mask.sum())
    root = 1e-3 * rng.standard_normal((count, count))
    model = MeasurementModel(cameras, root @ root.T, table(), (PIXELS,) * 4)
    assert compare(model, TrackerSettings(), 6, 25, seed=2) > 20


def test_what_there_is_no_room_for_is_done_by_the_definition() -> None:
    """Seventy peaks in one gate are more than the kernel's words have bits."""
    settings = TrackerSettings(max_prediction_sigma_px=1e6)
    model = MeasurementModel(CameraStack.of(ring()))
    motion = MotionModels.of(settings)
    native = Associator(model, motion, settings)
    states, bias = states_from_points(
        model, motion, settings, MIDDLE_MM[None] + [[0.0], [1.0]], np.full((2, 4), 0.05)
    )
    states = mix_and_predict(motion, states, np.full(2, 0.1))
    reading = model.predict(MIDDLE_MM[None]).reading_px[0]
    position = reading[:, None] + np.linspace(-3.0, 3.0, 70)
    peaks = Measurements.of(position, np.full_like(position, 0.05))
    same(
        associate(model, motion, settings, states, bias, peaks),
        native.associate(states, bias, peaks),
    )
