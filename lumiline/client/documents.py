"""What the server answers, typed; members that a newer server adds are kept as attributes."""

from lumiline.client.answer import Answer, Matrix3, Matrix4, Matrix6, Row6, Vector3
from lumiline.client.devices.documents import (
    Calibration,
    Device,
    DeviceStatus,
    Estimate,
    Reconstruction,
    Sensor,
    StatusAnswer,
)
from lumiline.client.holds.documents import (
    Hold,
    HoldState,
)
from lumiline.client.recordings.documents import (
    Export,
    Recording,
    Run,
    RunProblem,
)
from lumiline.client.registrations.documents import (
    FiducialError,
    FrameMarker,
    Frames,
    FrameState,
    FrameTransform,
    Registration,
    SurfaceFit,
    TargetError,
)
from lumiline.client.tools.documents import (
    MeasuredPoint,
    Pose,
    Tip,
    Tool,
    ToolCalibration,
)

__all__ = [
    "Answer",
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
    "Hold",
    "HoldState",
    "Matrix3",
    "Matrix4",
    "Matrix6",
    "MeasuredPoint",
    "Pose",
    "Reconstruction",
    "Recording",
    "Registration",
    "Row6",
    "Run",
    "RunProblem",
    "Sensor",
    "StatusAnswer",
    "SurfaceFit",
    "TargetError",
    "Tip",
    "Tool",
    "ToolCalibration",
    "Vector3",
]
