"""BarPlacement: bars of one hall see one scene at one time, each from where it stands."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from hardware.line_frame import LineFrame
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.placement import DAY_NS, BarPlacement
from hardware.simulated.scenes import RotatingBar
from hardware.simulated.settings import SimulationSettings
from hardware.simulated.simulated_rig import simulated_sensor_models

SIDE = BarPlacement((1500.0, 0.0, 0.0), (0.0, -np.pi / 2.0, 0.0), 3.0)
FRONT = BarPlacement((0.0, 0.0, -1500.0))
SCENE = RotatingBar(centre_mm=(0.0, 0.0, 0.0), period_s=0.5)


def first_frames(placement: BarPlacement, count: int = 4) -> list[LineFrame]:
    settings = SimulationSettings(
        scene=SCENE, frame_rate_hz=50.0, placement=placement, read_noise_electrons=0.0
    )
    driver = SimulatedDriver("bar", settings)
    driver.open()
    frames = driver.frames()
    found = [next(frames) for _ in range(count)]
    driver.close()
    return found


def test_points_are_turned_into_the_bars_coordinates() -> None:
    point = np.array([100.0, 20.0, -30.0])
    rotation = Rotation.from_rotvec(SIDE.rotation_rad)
    expected = rotation.inv().apply(point - np.array(SIDE.position_mm))
    np.testing.assert_allclose(SIDE.in_bar(point), expected, atol=1e-9)
    # The middle of the hall is in front of both.
    for placement in (SIDE, FRONT):
        np.testing.assert_allclose(placement.in_bar(np.zeros(3)), [0.0, 0.0, 1500.0], atol=1e-9)


@pytest.mark.parametrize("placement", [FRONT, SIDE])
def test_scans_show_the_scene_of_their_host_time(placement: BarPlacement) -> None:
    cameras = CameraStack.of(simulated_sensor_models())
    for frame in first_frames(placement):
        assert frame.marker is not None
        time_s = 1e-9 * (frame.exposure_host_ns % DAY_NS)
        marker = SCENE.points(time_s)[frame.marker]
        reading = cameras.project(placement.in_bar(marker)[None])[0]
        light = np.maximum(frame.lines.astype(np.float64) - 120.0, 0.0)
        centre = (light * np.arange(light.shape[1])).sum(axis=1) / light.sum(axis=1)
        np.testing.assert_allclose(centre, reading, atol=1.5)


def test_bars_of_one_rate_light_the_same_marker() -> None:
    cycle_ns = 40_000_000
    for placement, delay_ns in ((FRONT, 0), (SIDE, 3_000_000)):
        frame = first_frames(placement, 1)[0]
        # In the middle of the first exposure of a cycle.
        phase_ns = (frame.exposure_host_ns % DAY_NS - delay_ns) % cycle_ns
        assert abs(phase_ns - 10_000_000) < 500_000
        assert frame.marker == 0


def test_a_delay_out_of_range_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="delay_ms"):
        BarPlacement(delay_ms=-1.0)
