"""What the server answers about beam holds."""

from typing import Any

from lumiline.client.response_model import ResponseModel, Vector3


class BeamHold(ResponseModel):
    """A beam hold."""

    id: str
    device: str
    title: str
    watch: dict[str, Any]
    limits: dict[str, Any]
    rules: dict[str, Any]
    reference: dict[str, Any] | None


class BeamHoldStatus(ResponseModel):
    """Whether a beam is held now: only ``held`` false lets it go on."""

    hold: str
    device: str
    held: bool
    cause: str
    reason: str | None
    since_ns: int
    exposure_ns: int | None
    sequence: int | None
    shift_mm: Vector3 | None
    rotation_rad: Vector3 | None
    probability: float | None
