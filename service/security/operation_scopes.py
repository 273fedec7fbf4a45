"""Scopes of operations: which scope each needs, and what is public."""

from collections.abc import Mapping
from typing import Final, Literal

from service.principal import Scope

PUBLIC: Final = "public"
"""Needs no key: it tells nothing of this installation but whether it is up."""

Access = Scope | Literal["public"]

OPERATION_SCOPES: Final[Mapping[str, Access]] = {
    # The contract and the meaning of problems are the same on every server, and a client needs
    # them before it has a key; health is for supervisors that have none.
    "get-landing": "public",
    "get-health": "public",
    "get-readiness": "public",
    "list-problems": "public",
    "get-problem": "public",
    "openapi": "public",
    "swagger-ui": "public",
    "redoc": "public",
    "api-page-asset": "public",
    "stream_by_http": "public",  # says that it is a websocket
    "unknown_websocket": "public",
    "stream": "read:stream",
    "list-devices": "read:stream",
    "get-device": "read:stream",
    "get-device-state": "read:stream",
    "list-recordings": "read:stream",
    "get-recording": "read:stream",
    "download-recording": "read:stream",
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
    "delete-reconstruction": "write:calibration",
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
    # What a tool is and where its tip is decides what a pose means, as a calibration does; who
    # calibrates pointers need not be able to stop devices.
    "create-tool": "write:calibration",
    "capture-tool": "write:calibration",
    "change-tool": "write:calibration",
    "delete-tool": "write:calibration",
    "calibrate-pivot": "write:calibration",
    "calibrate-spin": "write:calibration",
    "create-registration": "write:calibration",
    "delete-registration": "write:calibration",
    # Who may see where a patient is may see whether that is within the limits; who may say what
    # the limits are may say where the patient is to be, and that the beam may go on.
    "list-beam-holds": "read:stream",
    "get-beam-hold": "read:stream",
    "get-beam-hold-state": "read:stream",
    "create-beam-hold": "write:calibration",
    "change-beam-hold": "write:calibration",
    "delete-beam-hold": "write:calibration",
    "set-beam-hold-reference": "write:calibration",
    "remove-beam-hold-reference": "write:calibration",
    "acknowledge-beam-hold": "write:calibration",
    "list-quality-checks": "read:calibration",
    "get-quality-check": "read:calibration",
    "get-quality": "read:calibration",
    "get-quality-picture": "read:calibration",
    "get-watch": "read:calibration",
    "list-watch-samples": "read:calibration",
    "create-quality-check": "write:calibration",
    "delete-quality-check": "write:calibration",
    "set-watch": "write:calibration",
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
    "list-radiometric-calibrations": "read:calibration",
    "get-radiometric-calibration": "read:calibration",
    "list-radiometric-activations": "read:calibration",
    "list-radiometric-captures": "read:calibration",
    "get-radiometric-capture": "read:calibration",
    "list-correction-tables": "read:calibration",
    "get-correction-table": "read:calibration",
    "download-correction-table": "read:calibration",
    "create-calibration": "write:calibration",
    "activate-calibration": "write:calibration",
    "retire-calibration": "write:calibration",
    "roll-back-device": "write:calibration",
    "create-calibration-run": "write:calibration",
    "create-self-calibration-run": "write:calibration",
    "create-mapping-run": "write:calibration",
    "create-update-run": "write:calibration",
    # It costs the server time and room, as other runs do, and changes nothing that is measured.
    "create-export-run": "write:calibration",
    "delete-export": "write:calibration",
    "create-drift-check": "write:calibration",
    "cancel-run": "write:calibration",
    "delete-run": "write:calibration",
    "create-capture": "write:calibration",
    "capture-target": "write:calibration",
    "delete-capture": "write:calibration",
    "create-radiometric-capture": "write:calibration",
    "capture-radiometric-frames": "write:calibration",
    "delete-radiometric-capture": "write:calibration",
    "create-radiometric-calibration": "write:calibration",
    "activate-radiometric-calibration": "write:calibration",
    "deactivate-radiometric-calibration": "write:calibration",
    "upload-correction-table": "write:calibration",
    "activate-correction-table": "write:calibration",
    "deactivate-correction-table": "write:calibration",
    "delete-correction-table": "write:calibration",
    "create-device": "admin:hardware",
    "change-device": "admin:hardware",
    "delete-device": "admin:hardware",
    "start-device": "admin:hardware",
    "stop-device": "admin:hardware",
    "start-recording": "admin:hardware",
    "stop-recording": "admin:hardware",
    "delete-recording": "admin:hardware",
    "list-keys": "admin:keys",
    "create-key": "admin:keys",
    "get-key": "admin:keys",
    "revoke-key": "admin:keys",
    "list-audit": "admin:keys",
}
"""Every route by its operation id; routes outside the contract by their name."""

WRITE_SCOPES: Final[frozenset[Access]] = frozenset(
    {"write:calibration", "admin:hardware", "admin:keys"}
)
"""Scopes of which every operation that is no GET goes into the audit log."""
