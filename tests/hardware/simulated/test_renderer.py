"""FrameRenderer: lit markers, positions, brightness, independence of order."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from hardware.simulated.driver import FrameRenderer
from hardware.simulated.frame_batch import BATCH
from hardware.simulated.scenes import CalibrationTarget, RotatingBar, StillPoints
from hardware.simulated.settings import SimulationSettings
from hardware.simulated.simulated_rig import PIXELS, simulated_sensor_models

THREE = StillPoints(((0.0, 0.0, 1500.0), (90.0, 60.0, 1450.0), (-130.0, -20.0, 1550.0)))


def readings(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    return CameraStack.of(simulated_sensor_models()).project(points_mm)


def centroids(light: NDArray[np.float64]) -> NDArray[np.float64]:
    return light @ np.arange(PIXELS) / light.sum(axis=-1)


def test_strobing_lights_the_markers_in_turn() -> None:
    renderer = FrameRenderer(SimulationSettings(scene=THREE))
    sequence = np.arange(10, 17)
    light = renderer.signal_electrons(sequence)
    timing = SimulationSettings(scene=THREE).timing
    lit = [timing.marker(int(number)) for number in sequence]
    assert lit == [1, 2, 0, 1, 2, 0, 1]
    np.testing.assert_allclose(
        centroids(light), readings(np.array(THREE.points_mm))[lit], atol=1e-6
    )


def test_all_markers_are_lit_together_when_simultaneous() -> None:
    settings = SimulationSettings(scene=THREE, illumination="simultaneous")
    together = FrameRenderer(settings).signal_electrons(np.array([4]))
    one_by_one = FrameRenderer(replace(settings, illumination="strobed")).signal_electrons(
        np.array([0, 1, 2])
    )
    np.testing.assert_allclose(together[0], one_by_one.sum(axis=0), atol=1e-6)
    assert settings.timing.marker(4) is None


def test_the_moving_bar_is_where_it_is_in_the_middle_of_the_exposure() -> None:
    bar = RotatingBar()
    renderer = FrameRenderer(SimulationSettings(scene=bar, frame_rate_hz=500.0))
    light = renderer.signal_electrons(np.array([321]))
    assert SimulationSettings(frame_rate_hz=500.0).timing.time_ns(321) == 643_000_000
    np.testing.assert_allclose(centroids(light[0]), readings(bar.points(0.643)[[1]])[0], atol=1e-6)


def test_the_light_follows_the_distance_unless_told_not_to() -> None:
    near_and_far = StillPoints(((0.0, 0.0, 1200.0), (0.0, 0.0, 1900.0)))
    settings = SimulationSettings(scene=near_and_far)
    near, far = FrameRenderer(settings).signal_electrons(np.array([0, 1])).sum(axis=2)
    assert (near > 2.0 * far).all()
    even = FrameRenderer(replace(settings, distance_falloff=False))
    np.testing.assert_allclose(
        even.signal_electrons(np.array([0, 1])).sum(axis=2), settings.signal_electrons, rtol=1e-8
    )


@pytest.mark.parametrize(
    "settings",
    [
        SimulationSettings(),
        SimulationSettings(scene=CalibrationTarget(), illumination="simultaneous"),
    ],
)
def test_a_batch_has_the_same_bits_in_whatever_order_it_is_rendered(
    settings: SimulationSettings,
) -> None:
    forward, backward = FrameRenderer(settings), FrameRenderer(settings)
    first = [forward.batch(number).lines for number in range(4)]
    second = [backward.batch(number).lines for number in (3, 1, 0, 2)]
    for lines, place in zip(first, (2, 1, 3, 0), strict=True):
        np.testing.assert_array_equal(lines, second[place])


def test_batches_and_seeds_differ() -> None:
    still = SimulationSettings(scene=StillPoints(((0.0, 0.0, 1500.0),)))
    renderer = FrameRenderer(still)
    lines = renderer.batch(0).lines
    assert (lines != renderer.batch(1).lines).mean() > 0.5
    assert (lines != FrameRenderer(replace(still, seed=2)).batch(0).lines).mean() > 0.5
    assert (lines[0] != lines[1]).mean() > 0.5


def test_counts_average_to_the_light_that_was_put_in() -> None:
    settings = SimulationSettings(scene=StillPoints(((40.0, -30.0, 1480.0),)))
    renderer = FrameRenderer(settings)
    batches = 40
    mean = np.mean([renderer.batch(number).lines for number in range(batches)], axis=(0, 1))
    collected = renderer.signal_electrons(np.array([0]))[0] + settings.ambient_electrons
    gain = settings.electrons_per_count
    expected = collected / gain + settings.offset_counts
    variance = (collected + settings.read_noise_electrons**2) / gain**2 + 1.0 / 12.0
    deviation = (mean - expected) / np.sqrt(variance / (batches * BATCH))
    # 8192 independent, nearly normal deviations: their mean square has the deviation sqrt(2/n).
    assert (deviation**2).mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.1 / deviation.size))
    assert abs(deviation).max() < 6.5


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_full_scale_is_reported_frame_by_frame(bits: int) -> None:
    """The second marker is so far away that it saturates nothing."""
    settings = SimulationSettings(
        scene=StillPoints(((0.0, 0.0, 1400.0), (0.0, 0.0, 60_000.0))),
        bits=bits,
        electrons_per_count=400_000.0 / 2**bits if bits < 16 else 1.0,
        signal_electrons=1e8,
        full_well_electrons=1e7,
    )
    batch = FrameRenderer(settings).batch(0)
    assert batch.saturated.tolist() == [True, False] * (BATCH // 2)
    assert int(batch.lines[0].max()) == 2**bits - 1
    assert int(batch.lines[1].max()) < 2**bits - 1


def test_rendered_lines_cannot_be_written_to() -> None:
    with pytest.raises(ValueError, match="read-only"):
        FrameRenderer(SimulationSettings()).batch(0).lines[0, 0, 0] = 1
