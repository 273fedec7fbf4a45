"""Tool and four sensors of case partial-view."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.optics.sensor_placement import place_sensor

Array = NDArray[np.float64]

SIGMA_PX: Final = 0.05
MARKERS_MM: Final = np.array(
    [[0.0, 0.0, 0.0], [60.0, 0.0, 5.0], [20.0, 50.0, 0.0], [-30.0, 30.0, 25.0]]
)
TIP_MM: Final = np.array([0.0, 0.0, -150.0])
CENTRE_MM: Final = np.array([0.0, 0.0, 1500.0])
SIZE_MM: Final = np.array([300.0, 300.0, 300.0])
COVARIANCE: Final = np.diag(np.tile([1.0, 0.5, 1e-4, 1e-4, 1e-4, 0.05, 0.1], 4) ** 2)
"""Of the cameras' parameters: 1 px of principal distance, 0.1 mrad, 0.05 and 0.1 mm of place."""


def rig() -> CameraStack:
    """Four sensors on a bar of 600 mm that read in four directions, aimed 1.5 m away."""
    angles = np.pi / 2 + np.pi / 4 * np.arange(4)
    return CameraStack.of(
        [
            place_sensor(
                f"s{index + 1}",
                lens_position_mm=(x, 0.0, 0.0),
                aim_mm=(0.0, 0.0, 1500.0),
                measured_direction=(float(np.cos(angle)), float(np.sin(angle)), 0.0),
                principal_distance_mm=36.0,
                pixels=2048,
                pitch_um=12.0,
            ).model
            for index, (x, angle) in enumerate(
                zip((-300.0, -100.0, 100.0, 300.0), angles, strict=True)
            )
        ]
    )
