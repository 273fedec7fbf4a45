"""What the server answers, typed; members that a newer server adds are kept as attributes."""

from lumiline.client.beam_holds.models import (
    BeamHold,
    BeamHoldStatus,
)
from lumiline.client.devices.models import (
    Calibration,
    Device,
    DeviceStatus,
    Estimate,
    Reconstruction,
    Sensor,
    StatusResponse,
)
from lumiline.client.recordings.models import (
    Export,
    Recording,
    Run,
    RunProblem,
)
from lumiline.client.registrations.models import (
    FiducialError,
    FrameMarker,
    Frames,
    FrameState,
    FrameTransform,
    Registration,
    SurfaceFit,
    TargetError,
)
from lumiline.client.response_model import Matrix3, Matrix4, Matrix6, ResponseModel, Row6, Vector3
from lumiline.client.tools.models import (
    MeasuredPoint,
    Pose,
    Tip,
    Tool,
    ToolCalibration,
)

__all__ = [
    "BeamHold",
    "BeamHoldStatus",
    "Calibration",
    "Device",
    "DeviceStatus",
    "Estimate",
    "Export",
    "FiducialError",
    "FrameMarker",
    "FrameState",
    "FrameTransform",
    "Frames",
    "Matrix3",
    "Matrix4",
    "Matrix6",
    "MeasuredPoint",
    "Pose",
    "Reconstruction",
    "Recording",
    "Registration",
    "ResponseModel",
    "Row6",
    "Run",
    "RunProblem",
    "Sensor",
    "StatusResponse",
    "SurfaceFit",
    "TargetError",
    "Tip",
    "Tool",
    "ToolCalibration",
    "Vector3",
]
