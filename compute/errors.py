"""The domain's exceptions: one base, one class for each thing that can be wrong with data."""

import re
from typing import ClassVar


class LumilineError(Exception):
    """Base of the errors that users see: what was wrong with an input or a state.

    ``detail`` says what was wrong, with the value, and what would be right. ``code`` is a stable
    name (the last part of a problem type's URI), by default the class's name with hyphens;
    ``context`` holds the values by name.
    """

    code: ClassVar[str] = "error"

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "code" not in vars(cls):
            cls.code = re.sub(r"(?<!^)(?=[A-Z])", "-", cls.__name__).lower()

    def __init__(self, detail: str, **context: object) -> None:
        super().__init__(detail)
        self.detail = detail
        self.context = context


class TooFewPoints(LumilineError):
    """Fewer observations than the model has parameters, or than planes that make a point."""


class DegeneratePoints(LumilineError):
    """Control points lie (almost) in one plane, which leaves the camera matrix rank 5 of 7."""

    code = "coplanar-points"


class UndeterminedParameters(LumilineError):
    """Observations leave a combination of unknowns open: more than one solution fits."""


class NonFiniteValue(LumilineError):
    """A value is NaN or infinite."""


class UnknownSensor(LumilineError):
    """A reading names a sensor that the device does not have."""


class DuplicatePoint(LumilineError):
    """A control point, or a reading of a point by one sensor, is given twice."""


class ReadingOutsideSensor(LumilineError):
    """A reading lies outside the sensor's pixels."""


class ImplausibleReadings(LumilineError):
    """A sensor's readings are unrelated to the points, copied, or 0 where it did not see them."""


class NoConvergence(LumilineError):
    """An iteration did not converge, or left the domain of its model."""


class InvalidParameter(LumilineError):
    """A parameter is outside the range in which it means something."""


class InvalidRecording(LumilineError):
    """A recorded file is not one of ours, is cut short, or contradicts itself."""


class TooFewPoses(LumilineError):
    """Fewer poses, or fewer that agree, than a calibration of a tool needs."""


class TooLittleRotation(LumilineError):
    """A tool was not turned far enough, or not about the axes that a calibration needs."""


class HighError(LumilineError):
    """Residual exceeds its limit."""


class CollinearPoints(LumilineError):
    """Points lie (almost) on one line, which leaves a rotation about it undetermined."""


class NotStationary(LumilineError):
    """A point was to be measured at rest, and moved."""


class UnknownFrame(LumilineError):
    """No coordinate frame has this name, or nothing connects it with the other one."""


class FrameConflict(LumilineError):
    """A transform would connect frames that are connected already, another way."""


class DegenerateTool(LumilineError):
    """A tool's markers cannot tell its pose: too few, on a line, too near, or exchangeable."""


class IndistinguishableTools(LumilineError):
    """Two tools have markers with the same distances, or the same strobe slots."""
