"""Catalogue of problem types: code, HTTP status, title and meaning (RFC 9457)."""

import inspect
from collections.abc import Iterable
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, Field

import service.problems.errors as own
from compute import errors as domain
from compute.errors import LumilineError
from hardware import errors as drivers

MEDIA_TYPE: Final = "application/problem+json"

_STATUS: Final[dict[str, int]] = {
    own.UnknownDevice.code: 404,
    own.UnknownCalibration.code: 404,
    own.UnknownReconstruction.code: 404,
    own.UnknownRecording.code: 404,
    own.RecordingExists.code: 409,
    own.RecordingInProgress.code: 409,
    own.RecordingInUse.code: 409,
    own.UnknownExport.code: 404,
    own.ExportExists.code: 409,
    own.InsufficientStorage.code: 507,
    own.UnknownRun.code: 404,
    own.UnknownCorrectionTable.code: 404,
    own.UnknownCapture.code: 404,
    own.UnknownTarget.code: 404,
    own.UnknownDriftCheck.code: 404,
    own.UnknownTool.code: 404,
    own.UnknownRegistration.code: 404,
    own.ToolExists.code: 409,
    own.ToolInUse.code: 409,
    own.TooManyTools.code: 409,
    own.ToolReplaced.code: 409,
    domain.UnknownFrame.code: 404,
    own.TipNotCalibrated.code: 409,
    own.MarkersTaken.code: 409,
    own.RegistrationExists.code: 409,
    own.RegistrationReplaced.code: 409,
    own.UnknownBeamHold.code: 404,
    own.BeamHoldExists.code: 409,
    own.TooManyBeamHolds.code: 409,
    own.BeamHoldReplaced.code: 409,
    own.NoSuchFigure.code: 404,
    own.UnknownDeviceProfile.code: 404,
    own.UnknownProblem.code: 404,
    own.DeviceExists.code: 409,
    own.CalibrationExists.code: 409,
    own.ReconstructionExists.code: 409,
    own.DeviceInUse.code: 409,
    own.DeviceRunning.code: 409,
    own.SensorsChanged.code: 409,
    own.DeviceWithoutDriver.code: 409,
    own.CalibrationActive.code: 409,
    own.CalibrationRetired.code: 409,
    own.NoActiveCalibration.code: 409,
    own.RunExists.code: 409,
    own.CorrectionTableExists.code: 409,
    own.CaptureExists.code: 409,
    own.DriftCheckExists.code: 409,
    own.UnknownQualityCheck.code: 404,
    own.QualityCheckExists.code: 409,
    own.CalibrationSwitched.code: 409,
    own.NothingToRollBack.code: 409,
    own.TableOfAnotherCalibration.code: 409,
    own.DeviceNotRunning.code: 409,
    drivers.DeviceNotConnected.code: 409,
    drivers.DeviceChanged.code: 409,
    drivers.MissingLibrary.code: 503,
    own.CaptureIncomplete.code: 409,
    own.CaptureComplete.code: 409,
    own.CaptureOfAnotherDevice.code: 409,
    own.NoObservation.code: 409,
    own.TargetMoved.code: 409,
    own.MarkerNotMoved.code: 409,
    own.RunNotEnded.code: 409,
    own.CorrectionTableInUse.code: 409,
    own.UnknownKey.code: 404,
    own.ActivationConflict.code: 409,
    own.DatabaseNotEmpty.code: 409,
    own.DatabaseInUse.code: 409,
    own.Unauthenticated.code: 401,
    own.MissingScope.code: 403,
    own.CredentialInQuery.code: 400,
    own.QueryTooLong.code: 414,
    own.BodyTooSlow.code: 408,
    own.MalformedRequest.code: 400,
    own.HeadTooSlow.code: 408,
    own.HeadTooLarge.code: 431,
    own.TooManyAttempts.code: 429,
    own.TooManyStreams.code: 429,
    own.DatabaseDamaged.code: 500,
    own.WorkerEnded.code: 500,
    own.NotReady.code: 503,
    own.Busy.code: 503,
    own.CrossOrigin.code: 403,
    own.UpgradeRequired.code: 426,
    own.MalformedJson.code: 400,
    own.DuplicateKey.code: 400,
    own.UnsupportedMediaType.code: 415,
    own.BodyTooLarge.code: 413,
}
"""Statuses of the errors that are not 422, which is that of every other domain error."""

_PROTOCOL: Final[tuple[tuple[str, int, str], ...]] = (
    ("bad-request", 400, "The request cannot be read as HTTP or does not fit this server."),
    ("not-found", 404, "No resource has this path."),
    ("method-not-allowed", 405, "The resource exists; the header Allow lists its methods."),
    ("invalid-request", 422, "The request does not fit the schema; `errors` lists every place."),
    ("internal-error", 500, "The server failed; its log has the cause under the same reference."),
)


class ProblemType(BaseModel):
    """What a problem type means."""

    model_config = ConfigDict(frozen=True)

    code: str = Field(description="Stable name, the last part of the type's URI reference.")
    type: str = Field(description="The `type` of problem documents.")
    status: int = Field(description="The HTTP status that goes with it.")
    title: str
    meaning: str


class FieldError(BaseModel):
    """One place in a request that does not fit."""

    location: list[str | int] = Field(description="Path to the value, from `body`, `query`, ...")
    message: str
    input: str = Field(description="The value found there as JSON text, cut at 200 characters.")


class Problem(BaseModel):
    """A problem document (RFC 9457)."""

    type: str = Field(description="URI reference of the problem type; GET it for its meaning.")
    title: str
    status: int
    detail: str = Field(description="What was wrong, with the value, and what would be right.")
    instance: str = Field(description="The path that was requested.")
    errors: list[FieldError] | None = None
    context: dict[str, Any] | None = Field(default=None, description="The values by name.")


def _domain_types() -> Iterable[ProblemType]:
    for module in (domain, drivers, own):
        for _, found in inspect.getmembers(module, inspect.isclass):
            if found is LumilineError or not issubclass(found, LumilineError):
                continue
            if found.__module__ == module.__name__:
                yield problem_type_of(found)


def problem_type_of(error: type[LumilineError]) -> ProblemType:
    """Return the problem type of an error class; its docstring is the meaning."""
    meaning = " ".join((inspect.getdoc(error) or error.code).split())
    return _problem_type(error.code, _STATUS.get(error.code, 422), meaning)


def _problem_type(code: str, status: int, meaning: str) -> ProblemType:
    title = code.replace("-", " ").capitalize().replace("json", "JSON")
    return ProblemType(
        code=code, type=f"/problems/{code}", status=status, title=title, meaning=meaning
    )


PROBLEM_TYPES: Final[dict[str, ProblemType]] = {
    found.code: found
    for found in sorted(
        [*(_problem_type(*row) for row in _PROTOCOL), *_domain_types()],
        key=lambda found: (found.status, found.code),
    )
}
