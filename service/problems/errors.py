"""The service's own errors: unknown resources, conflicts, limits."""

from typing import ClassVar

from compute.errors import LumilineError


class ServiceError(LumilineError):
    """Base of the service's own errors, each with the HTTP status that answers it."""

    status: ClassVar[int]

    def __init_subclass__(cls, *, status: int = 422, **options: object) -> None:
        super().__init_subclass__(**options)
        cls.status = status


class UnknownDevice(ServiceError, status=404):
    """No device has the given id."""


class UnknownCalibration(ServiceError, status=404):
    """No calibration has the given id."""


class UnknownReconstruction(ServiceError, status=404):
    """No reconstruction has the given id."""


class UnknownRun(ServiceError, status=404):
    """No run has the given id."""


class UnknownCorrectionTable(ServiceError, status=404):
    """No correction table has the given id."""


class UnknownCapture(ServiceError, status=404):
    """No capture session has the given id."""


class UnknownDriftCheck(ServiceError, status=404):
    """No drift check has the given id."""


class NoSuchFigure(ServiceError, status=404):
    """The report has no such figure: the calibration holds nothing that it would show."""


class UnknownTarget(ServiceError, status=404):
    """The capture session has no target of the given name."""


class UnknownRecording(ServiceError, status=404):
    """No recording of the given name lies in the data directory's folder of recordings."""


class RecordingExists(ServiceError, status=409):
    """A recording of this name exists already; recordings are never overwritten."""


class RecordingInProgress(ServiceError, status=409):
    """The recording is being written, or the device has one that is; stop it first."""


class RecordingInUse(ServiceError, status=409):
    """A device replays the recording; give it another source, or delete it, first."""


class UnknownExport(ServiceError, status=404):
    """No export has the given id: it was never made, or was deleted."""


class ExportExists(ServiceError, status=409):
    """An export of this id exists already; exports are never overwritten."""


class InsufficientStorage(ServiceError, status=507):
    """The disk has less free space than the server leaves, or cannot be written to."""


class UnknownDeviceProfile(ServiceError, status=404):
    """No device profile has the given name."""


class UnknownProblem(ServiceError, status=404):
    """No problem type has the given code."""


class DeviceExists(ServiceError, status=409):
    """A device of this id exists already; ids are unique."""


class CalibrationExists(ServiceError, status=409):
    """A calibration of this id exists already; calibrations are never overwritten."""


class ReconstructionExists(ServiceError, status=409):
    """A reconstruction of this id exists already; choose another id, or leave it out."""


class RunExists(ServiceError, status=409):
    """A run of this id exists already; choose another id, or leave it out."""


class CorrectionTableExists(ServiceError, status=409):
    """A correction table of this id exists already; tables are never overwritten."""


class DriftCheckExists(ServiceError, status=409):
    """A drift check of this id exists already; choose another id, or leave it out."""


class CaptureExists(ServiceError, status=409):
    """A capture session of this id exists already; choose another id, or leave it out."""


class DeviceInUse(ServiceError, status=409):
    """The change would orphan what belongs to the device: calibrations, captures, runs, ..."""


class DeviceRunning(ServiceError, status=409):
    """The sensors of a running device do not change; stop it first."""


class SensorsChanged(ServiceError, status=409):
    """The calibration is of other sensors than the device has now; calibrate the device again."""


class NominalCalibrationMismatch(ServiceError, status=409):
    """The nominal calibration is of another simulated profile than the device's source."""


class DeviceWithoutDriver(ServiceError, status=409):
    """An external device has no driver that could be started: its readings are posted."""


class CalibrationActive(ServiceError, status=409):
    """The active calibration cannot be retired; activate another one first."""


class CalibrationRetired(ServiceError, status=409):
    """A retired calibration cannot be activated or used again."""


class NoActiveCalibration(ServiceError, status=409):
    """The device has no active calibration and the request names none."""


class CalibrationOfAnotherDevice(ServiceError):
    """The calibration named belongs to another device than the readings."""


class NothingToRollBack(ServiceError, status=409):
    """The device's history has no earlier activation to go back to."""


class TableOfAnotherCalibration(ServiceError, status=409):
    """The correction table belongs to another calibration than the one in question."""

    code = "foreign-correction-table"


class InvalidTableFile(ServiceError):
    """An uploaded file is no correction table, is cut short, contradicts itself or hides data."""


class NoValidCells(ServiceError):
    """No cell of one of a correction table's sensors is valid."""


class UnknownQualityCheck(ServiceError, status=404):
    """There is no quality check with this id."""


class QualityCheckExists(ServiceError, status=409):
    """The id that was chosen for a quality check is taken."""


class CalibrationSwitched(ServiceError, status=409):
    """Another calibration or table came into force while something was measured."""


class DeviceNotRunning(ServiceError, status=409):
    """What is captured comes from a running device; start it first."""


class DeviceElsewhere(ServiceError, status=421):
    """Another gateway on the same database has the devices; ask that one."""


class FileElsewhere(ServiceError, status=421):
    """The recording or export lies in the data directory of another gateway; ask that one."""


class CaptureIncomplete(ServiceError, status=409):
    """Targets of the capture session are not captured yet."""


class CaptureOfAnotherDevice(ServiceError, status=409):
    """The capture session named belongs to another device, or to other sensors than it has now."""


class CaptureComplete(ServiceError, status=409):
    """All targets of the session are captured; name one to capture it again."""


class NoObservation(ServiceError, status=409):
    """Fewer sensors than a point needs saw one clear peak in enough of the frames."""

    code = "nothing-seen"


class TargetMoved(ServiceError, status=409):
    """Readings of a target held still spread by more than their noise explains."""


class MarkerNotMoved(ServiceError, status=409):
    """A target reads as another one does: the marker is still there, or was named for both."""


class UnknownRadiometricCalibration(ServiceError, status=404):
    """No radiometric calibration has the given id."""


class RadiometricCalibrationExists(ServiceError, status=409):
    """A radiometric calibration of this id exists already; they are never overwritten."""


class UnknownRadiometricCapture(ServiceError, status=404):
    """No session of radiometric captures has the given id."""


class RadiometricCaptureExists(ServiceError, status=409):
    """A session of radiometric captures of this id exists already; choose another id."""


class UnknownWaveCapture(ServiceError, status=404):
    """No capture of a waved wand or body has the given id."""


class WaveCaptureExists(ServiceError, status=409):
    """A capture of a waved wand or body of this id exists already; choose another id."""


class RadiometricCaptureIncomplete(ServiceError, status=409):
    """The dark capture, or flat captures of enough levels of light, are missing."""


class UnusableRadiometricCapture(ServiceError, status=409):
    """Dark or flat frames that nothing can be estimated from: saturated, light in the dark, ..."""


class RunNotEnded(ServiceError, status=409):
    """A run that waits or runs is not deleted; cancel it first."""


class CalibrationInUse(ServiceError, status=409):
    """Results or the history refer to the calibration, so it is not deleted; it can be retired."""


class RadiometricCalibrationInUse(ServiceError, status=409):
    """The history refers to the radiometric calibration, so it is not deleted."""


class CorrectionTableInUse(ServiceError, status=409):
    """A table that was ever active or used is part of a history, and is not deleted."""


class WorkerEnded(ServiceError, status=500):
    """The process that computed ended without a result, or was ended by its limits."""


class Busy(ServiceError, status=503):
    """The server does as much of this at once as it may; try again a little later."""


class PreconditionFailed(ServiceError, status=412):
    """The resource was changed after it was read: If-Match has not its ETag. Read it again."""


class PreconditionRequired(ServiceError, status=428):
    """The change needs the header If-Match, so that no other change is undone unseen."""


class InvalidPrecondition(ServiceError):
    """The header If-Match holds neither entity tags in quotes nor `*`."""


class IdempotencyKeyReused(ServiceError):
    """The Idempotency-Key belongs to another request of the last 24 hours."""


class InvalidIdempotencyKey(ServiceError):
    """The header Idempotency-Key is not 1 to 255 visible ASCII characters."""


class RequestInProgress(ServiceError, status=409):
    """The same request, by its Idempotency-Key, is being carried out; ask again for its answer."""


class ActivationConflict(ServiceError, status=409):
    """Another request changed what the device uses, meanwhile or before; look, and ask again."""


class UnknownKey(ServiceError, status=404):
    """No API key has the given id."""


class UnknownWebhook(ServiceError, status=404):
    """No webhook has the given id."""


class WebhookExists(ServiceError, status=409):
    """The id is taken by another webhook."""


class TooManyWebhooks(ServiceError, status=409):
    """There are as many webhooks as may be."""


class WebhookTargetRefused(ServiceError, status=422):
    """No event is sent to such a URL."""


class Unauthenticated(ServiceError, status=401):
    """The operation needs a key or token, and none that is valid came with the request."""


class MissingScope(ServiceError, status=403):
    """The key or token is valid, and not allowed to do this."""


class CredentialInQuery(ServiceError, status=400):
    """A key is in the address, which servers and proxies write down; send it in a header."""


class QueryTooLong(ServiceError, status=414):
    """The part of the address after the question mark is too long; send less."""


class UnknownQueryMember(ServiceError, status=422):
    """The part of the address after the question mark has a name that is not known there."""


class TooManyAttempts(ServiceError, status=429):
    """Too many requests of this address came with keys that are not valid; wait."""


class TooManyStreams(ServiceError, status=429):
    """The key has as many open streams as it may; close one."""


class BodyTooSlow(ServiceError, status=408):
    """The request's body did not arrive within the time limit."""


class BackupUnusable(ServiceError):
    """A file is no backup of this service, is damaged, or is of a later version."""


class DatabaseNotEmpty(ServiceError, status=409):
    """A backup would replace what the database holds; say so, or use an empty one."""


class DatabaseInUse(ServiceError, status=409):
    """A server uses the database, which would be replaced under it; stop the server first."""


class UnknownTool(ServiceError, status=404):
    """No tool has this id."""


class ToolExists(ServiceError, status=409):
    """The id that a tool is to have is taken, by a tool or by a registration."""


class ToolInUse(ServiceError, status=409):
    """Poses of other tools, or registrations, are relative to the tool, or a hold watches it."""


class TooManyTools(ServiceError, status=409):
    """The device has as many tools as it may; delete one."""


class ToolReplaced(ServiceError, status=409):
    """The tool was created again, or its tip changed, while it was measured; do it again."""


class TipNotCalibrated(ServiceError, status=409):
    """The tool's working point is not known: it was neither given nor found by pivoting."""


class MarkersTaken(ServiceError, status=409):
    """Another tool of the device has a strobed marker of this number."""


class UnknownRegistration(ServiceError, status=404):
    """No registration has this id."""


class RegistrationExists(ServiceError, status=409):
    """The id that a registration is to have is taken, by a registration or by a tool."""


class RegistrationReplaced(ServiceError, status=409):
    """The registration was deleted, or made again, while it was used; do it again."""


class UnknownBeamHold(ServiceError, status=404):
    """No beam hold has this id."""


class BeamHoldExists(ServiceError, status=409):
    """The id that a beam hold is to have is taken."""


class TooManyBeamHolds(ServiceError, status=409):
    """The device has as many beam holds as it may; delete one."""


class BeamHoldReplaced(ServiceError, status=409):
    """The hold was deleted and created again while its reference was measured; do it again."""


class DatabaseDamaged(ServiceError, status=500):
    """What the database holds does not agree with itself."""


class CrossOrigin(ServiceError, status=403):
    """A web page of another origin asked for a change, or for a websocket."""


class UpgradeRequired(ServiceError, status=426):
    """The path is a websocket; plain HTTP requests have nothing there."""


class NotReady(ServiceError, status=503):
    """A part that requests need (database, live pipeline) does not answer."""


class StationNotReached(NotReady, status=503):
    """The station that the device belongs to does not answer; what was stored, it takes later."""


class StationFailed(ServiceError, status=502):
    """The station that the device belongs to failed at it; its log has the cause."""


class UnknownStation(ServiceError, status=422):
    """A device of a station needs a server with a bus, and a name that can be a station's."""


class DatabaseFull(NotReady, status=507):
    """The disk of the database is full: nothing was stored, and trying again does not help."""


class MalformedJson(ServiceError, status=400):
    """The request's body is not JSON (RFC 8259)."""


class DuplicateKey(ServiceError, status=400):
    """An object in the request's body has the same key twice, so one value would be lost."""


class UnsupportedMediaType(ServiceError, status=415):
    """The request's body is not declared as what the path takes, mostly ``application/json``."""


class MalformedRequest(ServiceError, status=400):
    """What came is not HTTP/1.1 (RFC 9112)."""


class HeadTooLarge(ServiceError, status=431):
    """The request line and the headers together are too large, or there are too many headers."""


class HeadTooSlow(ServiceError, status=408):
    """The request line and the headers did not arrive within the server's time; send again."""


class BodyTooLarge(ServiceError, status=413):
    """The request's body is larger than the server's limit."""
