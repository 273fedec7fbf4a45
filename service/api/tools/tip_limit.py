"""TipLimit: status of a tool's pose by the standard deviation of its tip."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from compute.pose.rigid_body import ToolPose
from service.api.devices.store import get_device, tracking_of
from service.api.tools.rigid_bodies import tip_of
from service.api.tools.schema import ToolLimits
from service.database.models import ToolRow

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TipLimit:
    """Limit of the tip's standard deviation above which a pose is HIGH_ERROR.

    The same rule as ``pose_in_frame`` has, without the poses' covariances in the other frame: some
    microseconds a tool.

    Args:
        max_sd_mm: standard deviation of the tip above which a pose is HIGH_ERROR [mm].
        tip_covariance_mm2: of the tip in the tool's coordinates, shape (3, 3) [mm^2]; None: exact.
        reference: id of the tool that the poses are wanted relative to; None: the tracker.
    """

    max_sd_mm: float
    tip_covariance_mm2: Array | None = None
    reference: str | None = None

    def exceeded_reason(self, pose: ToolPose, reference: ToolPose | None = None) -> str | None:
        """Return why a pose is HIGH_ERROR in a frame; None: it is not.

        Args:
            pose: of the tool, in the tracker's frame.
            reference: pose at the same instant of the tool whose frame it is; None: the tracker's.
        """
        sd_mm = tip_sd_mm(pose, reference, self.tip_covariance_mm2)
        return None if sd_mm is None else exceeded_reason(sd_mm, self.max_sd_mm)


def exceeded_reason(sd_mm: float, max_sd_mm: float) -> str | None:
    """Return the reason when a tip's sigma [mm] exceeds its limit; else None."""
    if sd_mm <= max_sd_mm:
        return None
    return (
        f"the tip's standard deviation in this frame is {sd_mm:.3g} mm; "
        f"{max_sd_mm:.3g} mm is the most"
    )


def tip_sd_mm(
    pose: ToolPose, reference: ToolPose | None = None, tip_covariance_mm2: Array | None = None
) -> float | None:
    """Return the sigma of a tip's position in a frame, root of the covariance's trace [mm].

    Turning a place into the frame changes no lengths, so its square is the trace of the place's
    covariance by the tool's pose, and of the same place's by the reference's.

    Args:
        pose: of the tool, in the tracker's frame.
        reference: of the tool whose frame it is; None: the tracker's.
        tip_covariance_mm2: of the tip in the tool's coordinates, shape (3, 3) [mm^2]; None: exact.

    Returns:
        None unless all poses tell their covariances, and the tip is known.
    """
    if pose.tip_mm is None:
        return None
    known = []
    for one in (pose, reference):
        if one is None:
            continue
        if one.covariance is None or one.translation_mm is None:
            return None
        known.append(_variance(one.covariance, pose.tip_mm - one.translation_mm))
    if tip_covariance_mm2 is not None:
        known.append(float(tip_covariance_mm2.trace()))
    # A sum of squares, but for rounding; what is not finite stays, and is above every limit.
    return math.sqrt(max(sum(known), 0.0))


def _variance(covariance: Array, arm_mm: Array) -> float:
    """Return the trace of J C J' with J = [-[arm]x, I]: what a turn sweeps, and the shift."""
    c = covariance.tolist()
    x, y, z = arm_mm.tolist()
    swept = (
        (y * y + z * z) * c[0][0]
        + (x * x + z * z) * c[1][1]
        + (x * x + y * y) * c[2][2]
        - 2.0 * (x * y * c[0][1] + x * z * c[0][2] + y * z * c[1][2])
    )
    both = x * (c[2][4] - c[1][5]) + y * (c[0][5] - c[2][3]) + z * (c[1][3] - c[0][4])
    return float(swept + 2.0 * both + c[3][3] + c[4][4] + c[5][5])


def max_tip_sd_mm(session: Session, tool: ToolRow) -> float:
    """Return the standard deviation of the tip above which a pose is HIGH_ERROR [mm]."""
    own = ToolLimits.model_validate(tool.limits).tip_sd_mm
    if own is not None:
        return own
    return tracking_of(get_device(session, tool.device_id)).tool_tip_sd_mm


def tip_limit_of(session: Session, tool: ToolRow) -> TipLimit:
    """Return the limit of a stored tool."""
    spread = tip_of(tool).covariance_mm2
    covariance = None if spread is None else np.array(spread, dtype=np.float64)
    return TipLimit(max_tip_sd_mm(session, tool), covariance, tool.reference_id)
