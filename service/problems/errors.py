"""The service's own errors: unknown resources, conflicts, limits."""

from compute.errors import LumilineError


class UnknownDevice(LumilineError):
    """No device has the given id."""

    code = "unknown-device"


class UnknownCalibration(LumilineError):
    """No calibration has the given id."""

    code = "unknown-calibration"


class UnknownReconstruction(LumilineError):
    """No reconstruction has the given id."""

    code = "unknown-reconstruction"


class UnknownRun(LumilineError):
    """No run has the given id."""

    code = "unknown-run"


class UnknownCorrectionTable(LumilineError):
    """No correction table has the given id."""

    code = "unknown-correction-table"


class UnknownCapture(LumilineError):
    """No capture session has the given id."""

    code = "unknown-capture"


class UnknownDriftCheck(LumilineError):
    """No drift check has the given id."""

    code = "unknown-drift-check"


class NoSuchFigure(LumilineError):
    """The report has no such figure: the calibration holds nothing that it would show."""

    code = "no-such-figure"


class UnknownTarget(LumilineError):
    """The capture session has no target of the given name."""

    code = "unknown-target"


class UnknownRecording(LumilineError):
    """No recording of the given name lies in the data directory's folder of recordings."""

    code = "unknown-recording"


class RecordingExists(LumilineError):
    """A recording of this name exists already; recordings are never overwritten."""

    code = "recording-exists"


class RecordingInProgress(LumilineError):
    """The recording is being written, or the device has one that is; stop it first."""

    code = "recording-in-progress"


class RecordingInUse(LumilineError):
    """A running device replays the recording; stop the device first."""

    code = "recording-in-use"


class UnknownExport(LumilineError):
    """No export has the given id: it was never made, or was deleted."""

    code = "unknown-export"


class ExportExists(LumilineError):
    """An export of this id exists already; exports are never overwritten."""

    code = "export-exists"


class InsufficientStorage(LumilineError):
    """The disk has less free space than the server leaves, or cannot be written to."""

    code = "insufficient-storage"


class UnknownDeviceProfile(LumilineError):
    """No device profile has the given name."""

    code = "unknown-device-profile"


class UnknownProblem(LumilineError):
    """No problem type has the given code."""

    code = "unknown-problem"


class DeviceExists(LumilineError):
    """A device of this id exists already; ids are unique."""

    code = "device-exists"


class CalibrationExists(LumilineError):
    """A calibration of this id exists already; calibrations are never overwritten."""

    code = "calibration-exists"


class ReconstructionExists(LumilineError):
    """A reconstruction of this id exists already; choose another id, or leave it out."""

    code = "reconstruction-exists"


class RunExists(LumilineError):
    """A run of this id exists already; choose another id, or leave it out."""

    code = "run-exists"


class CorrectionTableExists(LumilineError):
    """A correction table of this id exists already; tables are never overwritten."""

    code = "correction-table-exists"


class DriftCheckExists(LumilineError):
    """A drift check of this id exists already; choose another id, or leave it out."""

    code = "drift-check-exists"


class CaptureExists(LumilineError):
    """A capture session of this id exists already; choose another id, or leave it out."""

    code = "capture-exists"


class DeviceInUse(LumilineError):
    """The change would orphan what belongs to the device: calibrations, captures, runs, ..."""

    code = "device-in-use"


class DeviceRunning(LumilineError):
    """The sensors of a running device do not change; stop it first."""

    code = "device-running"


class SensorsChanged(LumilineError):
    """The calibration is of other sensors than the device has now; calibrate the device again."""

    code = "sensors-changed"


class DeviceWithoutDriver(LumilineError):
    """An external device has no driver that could be started: its readings are posted."""

    code = "device-without-driver"


class CalibrationActive(LumilineError):
    """The active calibration cannot be retired; activate another one first."""

    code = "calibration-active"


class CalibrationRetired(LumilineError):
    """A retired calibration cannot be activated or used again."""

    code = "calibration-retired"


class NoActiveCalibration(LumilineError):
    """The device has no active calibration and the request names none."""

    code = "no-active-calibration"


class CalibrationOfAnotherDevice(LumilineError):
    """The calibration named belongs to another device than the readings."""

    code = "calibration-of-another-device"


class NothingToRollBack(LumilineError):
    """The device's history has no earlier activation to go back to."""

    code = "nothing-to-roll-back"


class TableOfAnotherCalibration(LumilineError):
    """The correction table belongs to another calibration than the one in question."""

    code = "foreign-correction-table"


class InvalidTableFile(LumilineError):
    """An uploaded file is no correction table, is cut short, contradicts itself or hides data."""

    code = "invalid-table-file"


class TableHasHoles(LumilineError):
    """Cells inside a correction table's volume, or all of a sensor's, have no measurement."""

    code = "table-has-holes"


class UnknownQualityCheck(LumilineError):
    """There is no quality check with this id."""

    code = "unknown-quality-check"


class QualityCheckExists(LumilineError):
    """The id that was chosen for a quality check is taken."""

    code = "quality-check-exists"


class CalibrationSwitched(LumilineError):
    """Another calibration or table came into force while something was measured."""

    code = "calibration-switched"


class DeviceNotRunning(LumilineError):
    """What is captured comes from a running device; start it first."""

    code = "device-not-running"


class CaptureIncomplete(LumilineError):
    """Targets of the capture session are not captured yet."""

    code = "capture-incomplete"


class CaptureOfAnotherDevice(LumilineError):
    """The capture session named belongs to another device, or to other sensors than it has now."""

    code = "capture-of-another-device"


class CaptureComplete(LumilineError):
    """All targets of the session are captured; name one to capture it again."""

    code = "capture-complete"


class NoObservation(LumilineError):
    """Fewer sensors than a point needs saw one clear peak in enough of the frames."""

    code = "nothing-seen"


class TargetMoved(LumilineError):
    """Readings of a target held still spread by more than their noise explains."""

    code = "target-moved"


class MarkerNotMoved(LumilineError):
    """A target reads as another one does: the marker is still there, or was named for both."""

    code = "marker-not-moved"


class RunNotEnded(LumilineError):
    """A run that waits or runs is not deleted; cancel it first."""

    code = "run-not-ended"


class CorrectionTableInUse(LumilineError):
    """A table that was ever active or used is part of a history, and is not deleted."""

    code = "correction-table-in-use"


class WorkerEnded(LumilineError):
    """The process that computed ended without a result, or was ended by its limits."""

    code = "worker-ended"


class Busy(LumilineError):
    """The server does as much of this at once as it may; try again a little later."""

    code = "busy"


class ActivationConflict(LumilineError):
    """Another request changed what the device uses, meanwhile or before; look, and ask again."""

    code = "activation-conflict"


class UnknownKey(LumilineError):
    """No API key has the given id."""

    code = "unknown-key"


class Unauthenticated(LumilineError):
    """The operation needs a key or token, and none that is valid came with the request."""

    code = "unauthenticated"


class MissingScope(LumilineError):
    """The key or token is valid, and not allowed to do this."""

    code = "missing-scope"


class CredentialInQuery(LumilineError):
    """A key is in the address, which servers and proxies write down; send it in a header."""

    code = "credential-in-query"


class QueryTooLong(LumilineError):
    """The part of the address after the question mark is too long; send less."""

    code = "query-too-long"


class TooManyAttempts(LumilineError):
    """Too many requests of this address came with keys that are not valid; wait."""

    code = "too-many-attempts"


class TooManyStreams(LumilineError):
    """The key has as many open streams as it may; close one."""

    code = "too-many-streams"


class BodyTooSlow(LumilineError):
    """The request's body did not arrive within the time limit."""

    code = "body-too-slow"


class BackupUnusable(LumilineError):
    """A file is no backup of this service, is damaged, or is of a later version."""

    code = "backup-unusable"


class DatabaseNotEmpty(LumilineError):
    """A backup would replace what the database holds; say so, or use an empty one."""

    code = "database-not-empty"


class DatabaseInUse(LumilineError):
    """A server uses the database, which would be replaced under it; stop the server first."""

    code = "database-in-use"


class UnknownTool(LumilineError):
    """No tool has this id."""

    code = "unknown-tool"


class ToolExists(LumilineError):
    """The id that a tool is to have is taken, by a tool or by a registration."""

    code = "tool-exists"


class ToolInUse(LumilineError):
    """Poses of other tools, or registrations, are relative to the tool, or a hold watches it."""

    code = "tool-in-use"


class TooManyTools(LumilineError):
    """The device has as many tools as it may; delete one."""

    code = "too-many-tools"


class ToolReplaced(LumilineError):
    """The tool was created again, or its tip changed, while it was measured; do it again."""

    code = "tool-replaced"


class TipNotCalibrated(LumilineError):
    """The tool's working point is not known: it was neither given nor found by pivoting."""

    code = "tip-not-calibrated"


class MarkersTaken(LumilineError):
    """Another tool of the device has a strobed marker of this number."""

    code = "markers-taken"


class UnknownRegistration(LumilineError):
    """No registration has this id."""

    code = "unknown-registration"


class RegistrationExists(LumilineError):
    """The id that a registration is to have is taken, by a registration or by a tool."""

    code = "registration-exists"


class RegistrationReplaced(LumilineError):
    """The registration was deleted, or made again, while it was used; do it again."""

    code = "registration-replaced"


class UnknownBeamHold(LumilineError):
    """No beam hold has this id."""

    code = "unknown-beam-hold"


class BeamHoldExists(LumilineError):
    """The id that a beam hold is to have is taken."""

    code = "beam-hold-exists"


class TooManyBeamHolds(LumilineError):
    """The device has as many beam holds as it may; delete one."""

    code = "too-many-beam-holds"


class BeamHoldReplaced(LumilineError):
    """The hold was deleted and created again while its reference was measured; do it again."""

    code = "beam-hold-replaced"


class DatabaseDamaged(LumilineError):
    """What the database holds does not agree with itself."""

    code = "database-damaged"


class CrossOrigin(LumilineError):
    """A web page of another origin asked for a change, or for a websocket."""

    code = "cross-origin"


class UpgradeRequired(LumilineError):
    """The path is a websocket; plain HTTP requests have nothing there."""

    code = "upgrade-required"


class NotReady(LumilineError):
    """A part that requests need (database, live pipeline) does not answer."""

    code = "not-ready"


class MalformedJson(LumilineError):
    """The request's body is not JSON (RFC 8259)."""

    code = "malformed-json"


class DuplicateKey(LumilineError):
    """An object in the request's body has the same key twice, so one value would be lost."""

    code = "duplicate-key"


class UnsupportedMediaType(LumilineError):
    """The request's body is not declared as what the path takes, mostly ``application/json``."""

    code = "unsupported-media-type"


class MalformedRequest(LumilineError):
    """What came is not HTTP/1.1 (RFC 9112)."""

    code = "malformed-request"


class HeadTooLarge(LumilineError):
    """The request line and the headers together are larger than the server's limit."""

    code = "head-too-large"


class HeadTooSlow(LumilineError):
    """The request line and the headers did not arrive within the server's time; send again."""

    code = "head-too-slow"


class BodyTooLarge(LumilineError):
    """The request's body is larger than the server's limit."""

    code = "body-too-large"
