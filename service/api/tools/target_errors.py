"""Target registration errors of a stored registration."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from compute.pose.transform import Transform
from service.api.tools.registration_schema import Target


def target_errors(
    targets: Sequence[Target], measured_from_frame: Transform
) -> list[dict[str, Any]]:
    """Return the members of TargetError, by the covariance of the transform.

    Args:
        targets: places in the frame.
        measured_from_frame: the registration, with its covariance.
    """
    places = np.array([target.frame_mm for target in targets]).reshape(-1, 3)
    return [
        {
            "name": target.name,
            "error_mm": float(np.sqrt(np.trace(spread))),
            "covariance_mm2": spread.tolist(),
        }
        for target, spread in zip(
            targets, measured_from_frame.point_covariance(places), strict=True
        )
    ]
