"""Small frames: in one pass what is found step by step."""

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.reconstruction.correspondence import grouping as module
from tests.compute.reconstruction.matching import match_peaks
from tests.compute.reconstruction.peak_scene import random_scene
from tests.compute.rig import rig

Array = NDArray[np.float64]


@pytest.mark.parametrize(("missed", "false"), [(0.0, 0.0), (0.05, 0.1)])
def test_as_step_by_step(missed: float, false: float, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = CameraStack.of(rig(4))
    quick = module.group_four_sensor_frame
    taken: list[bool] = []

    def watched(*args: object) -> object:
        found = quick(*args)  # type: ignore[arg-type]
        taken.append(found is not None)
        return found

    for seed in range(40):
        scene = random_scene(cameras, 2 + seed % 3, seed, missed=missed, false=false)
        monkeypatch.setattr(module, "group_four_sensor_frame", watched)
        one = match_peaks(cameras, scene.position_px, scene.sigma_px)
        monkeypatch.setattr(module, "group_four_sensor_frame", lambda *_: None)
        other = match_peaks(cameras, scene.position_px, scene.sigma_px)
        np.testing.assert_array_equal(one.peaks, other.peaks)
        if np.isfinite(scene.position_px).sum(axis=1).prod() <= 256:
            # Beyond, chance is counted from other combinations: the same but for its noise.
            np.testing.assert_array_equal(one.ambiguous, other.ambiguous)
    assert sum(taken) >= 15
