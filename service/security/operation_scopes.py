"""Scopes of operations: which scope each needs, and what is public."""

from collections.abc import Mapping
from typing import Final, Literal

from service.principal import SCOPES, Scope

PUBLIC: Final = "public"
"""Needs no key: it tells nothing of this installation but whether it is up."""

Access = Scope | Literal["public"]

OPERATION_SCOPES: Final[Mapping[str, Access]] = {
    # The contract and the meaning of problems are the same on every server, and a client needs
    # them before it has a key; health is for supervisors that have none.
    "get-landing": "public",
    # The page holds nothing; what it shows it asks for with its reader's key.
    "dashboard": "public",
    "dashboard-file": "public",
    "get-health": "public",
    "get-readiness": "public",
    "list-problems": "public",
    "get-problem": "public",
    "openapi": "public",
    "asyncapi": "public",
    "swagger-ui": "public",
    "redoc": "public",
    "api-page-asset": "public",
    "stream_by_http": "public",  # says that it is a websocket
    "unknown_websocket": "public",
    "stream": "read:stream",
    "get-principal": "read:stream",
    "list-devices": "read:stream",
    "get-device": "read:stream",
    "get-device-state": "read:stream",
    "get-device-scans": "read:stream",
    "list-recordings": "read:stream",
    "get-recording": "read:stream",
    "download-recording": "read:stream",
    "get-recorded-frames": "read:stream",
    "get-recorded-scans": "read:stream",
    "get-recording-retention": "read:stream",
    # What is in them can be had from the recordings.
    "list-exports": "read:stream",
    "get-export": "read:stream",
    "download-export": "read:stream",
    "list-device-profiles": "read:stream",
    "get-device-profile": "read:stream",
    "get-plan": "read:stream",
    "get-plan-picture": "read:stream",
    # Names of devices and how much is done here are nobody else's business.
    "get-metrics": "read:stream",
    "find-peaks": "read:stream",
    "draw-peaks": "read:stream",
    # What the stream is for devices with a driver, this is for those whose readings are posted.
    "create-reconstruction": "read:stream",
    "list-reconstructions": "read:stream",
    "get-reconstruction": "read:stream",
    "delete-reconstruction": "write:results",
    # Who may see the points may see the poses, and what makes sense of them.
    "list-tools": "read:stream",
    "get-tool": "read:stream",
    "get-tool-pose": "read:stream",
    "list-tool-calibrations": "read:stream",
    "measure-point": "read:stream",
    "get-frames": "read:stream",
    "get-frame-transform": "read:stream",
    "list-registrations": "read:stream",
    "get-registration": "read:stream",
    # What a tool is and where its tip is decides what a pose means; a registration does so for one
    # patient, and whoever registers patients need not be able to change tools.
    "create-tool": "write:tools",
    "capture-tool": "write:tools",
    "change-tool": "write:tools",
    "delete-tool": "write:tools",
    "calibrate-pivot": "write:tools",
    "calibrate-spin": "write:tools",
    "create-registration": "write:registrations",
    "delete-registration": "write:registrations",
    # Who may see where a patient is may see whether that is within the limits. Whoever operates
    # says in each session where the patient is to be and that the beam may go on; what is watched,
    # and the limits, hold for all sessions.
    "list-beam-holds": "read:stream",
    "get-beam-hold": "read:stream",
    "get-beam-hold-state": "read:stream",
    "create-beam-hold": "write:holds",
    "change-beam-hold": "write:holds",
    "delete-beam-hold": "write:holds",
    "set-beam-hold-reference": "operate:holds",
    "remove-beam-hold-reference": "operate:holds",
    "acknowledge-beam-hold": "operate:holds",
    "list-quality-checks": "read:calibration",
    "get-quality-check": "read:calibration",
    "get-quality": "read:calibration",
    "get-quality-picture": "read:calibration",
    "get-watch": "read:calibration",
    "list-watch-samples": "read:calibration",
    "create-quality-check": "operate:checks",
    "delete-calibration": "write:calibrations",
    "delete-radiometric-calibration": "write:calibrations",
    "delete-drift-check": "write:calibrations",
    "delete-quality-check": "write:calibrations",
    "set-watch": "write:calibrations",
    "list-drift-checks": "read:calibration",
    "get-drift-check": "read:calibration",
    "list-calibrations": "read:calibration",
    "get-calibration": "read:calibration",
    "compare-calibrations": "read:calibration",
    "get-calibration-report": "read:calibration",
    "get-calibration-figure": "read:calibration",
    "list-activations": "read:calibration",
    "list-runs": "read:calibration",
    "get-run": "read:calibration",
    "list-captures": "read:calibration",
    "get-capture": "read:calibration",
    "list-wave-captures": "read:calibration",
    "get-wave-capture": "read:calibration",
    "list-radiometric-calibrations": "read:calibration",
    "get-radiometric-calibration": "read:calibration",
    "list-radiometric-activations": "read:calibration",
    "list-radiometric-captures": "read:calibration",
    "get-radiometric-capture": "read:calibration",
    "list-correction-tables": "read:calibration",
    "get-correction-table": "read:calibration",
    "download-correction-table": "read:calibration",
    "create-calibration": "write:calibrations",
    "create-nominal-calibration": "write:calibrations",
    "activate-calibration": "activate:calibrations",
    "retire-calibration": "activate:calibrations",
    "roll-back-device": "activate:calibrations",
    "create-calibration-run": "write:calibrations",
    "create-self-calibration-run": "write:calibrations",
    "create-mapping-run": "write:calibrations",
    "create-update-run": "write:calibrations",
    # It costs the server time and room, and changes nothing that is measured.
    "create-export-run": "write:results",
    "delete-export": "write:results",
    "create-drift-check": "operate:checks",
    "cancel-run": "write:results",
    "delete-run": "write:results",
    "create-capture": "write:calibrations",
    "capture-target": "write:calibrations",
    "delete-capture": "write:calibrations",
    "create-wave-capture": "write:calibrations",
    "start-wave-capture": "write:calibrations",
    "stop-wave-capture": "write:calibrations",
    "delete-wave-capture": "write:calibrations",
    "create-radiometric-capture": "write:calibrations",
    "capture-radiometric-frames": "write:calibrations",
    "delete-radiometric-capture": "write:calibrations",
    "create-radiometric-calibration": "write:calibrations",
    "activate-radiometric-calibration": "activate:calibrations",
    "deactivate-radiometric-calibration": "activate:calibrations",
    "upload-correction-table": "write:calibrations",
    "activate-correction-table": "activate:calibrations",
    "deactivate-correction-table": "activate:calibrations",
    "delete-correction-table": "write:calibrations",
    "create-device": "admin:devices",
    "create-device-profile": "admin:devices",
    # A profile of one's own may take the server long: whoever makes devices plans them.
    "plan-profile": "admin:devices",
    "change-device": "admin:devices",
    "delete-device": "admin:devices",
    "start-device": "operate:devices",
    "stop-device": "operate:devices",
    "start-recording": "operate:recordings",
    "stop-recording": "operate:recordings",
    "delete-recording": "write:recordings",
    # Whoever may read them sees addresses of the network.
    "list-webhooks": "admin:webhooks",
    "create-webhook": "admin:webhooks",
    "get-webhook": "admin:webhooks",
    "get-webhook-state": "admin:webhooks",
    "test-webhook": "admin:webhooks",
    "change-webhook": "admin:webhooks",
    "delete-webhook": "admin:webhooks",
    "list-keys": "admin:keys",
    "create-key": "admin:keys",
    "get-key": "admin:keys",
    "revoke-key": "admin:keys",
    "list-audit": "read:audit",
    # Lines of the log name addresses, devices and requests, as the audit log does.
    "list-log-records": "read:audit",
    "list-stream-clients": "read:audit",  # names of keys
    # Addresses, folders and limits are of use to who administers, and to who attacks.
    "list-settings": "read:audit",
    "list-backups": "read:audit",
}
"""Every route by its operation id; routes outside the contract by their name."""

RECORDED_SCOPES: Final[frozenset[Access]] = frozenset(
    scope for scope in SCOPES if not scope.startswith("read:")
)
"""Scopes of which every operation that is no GET goes into the audit log."""
