"""Requests about beam holds, for both clients."""

from collections.abc import Mapping
from typing import Any

from lumiline.client.api_request import ApiRequest, get, path_of, post
from lumiline.client.beam_holds import models as d


def beam_holds(device_id: str | None) -> ApiRequest[d.BeamHold]:
    """Beam holds."""
    return get(d.BeamHold, "beam-holds", device=device_id)


def beam_hold(hold_id: str) -> ApiRequest[d.BeamHold]:
    """One beam hold."""
    return get(d.BeamHold, "beam-holds", hold_id)


def create_beam_hold(
    hold_id: str,
    device_id: str,
    watch: Mapping[str, Any],
    limits: Mapping[str, Any],
    members: Mapping[str, Any],
) -> ApiRequest[d.BeamHold]:
    """Make a beam hold."""
    own = {"id": hold_id, "device": device_id, "watch": dict(watch), "limits": dict(limits)}
    return post(d.BeamHold, "beam-holds", body={"title": hold_id, **members, **own})


def change_beam_hold(hold_id: str, members: Mapping[str, Any]) -> ApiRequest[d.BeamHold]:
    """Change a beam hold."""
    return ApiRequest("PATCH", path_of("beam-holds", hold_id), d.BeamHold, body=dict(members))


def beam_hold_state(hold_id: str) -> ApiRequest[d.BeamHoldStatus]:
    """Whether a beam is held now."""
    return get(d.BeamHoldStatus, "beam-holds", hold_id, "state")


def set_beam_hold_reference(
    hold_id: str, frames: int, timeout_s: float, given: Mapping[str, Any] | None
) -> ApiRequest[d.BeamHold]:
    """Measure a hold's reference, or give it."""
    body = {
        "frames": frames,
        "timeout_s": timeout_s,
        "given": None if given is None else dict(given),
    }
    return post(d.BeamHold, "beam-holds", hold_id, "reference", body=body)


def remove_beam_hold_reference(hold_id: str) -> ApiRequest[d.BeamHold]:
    """Take a hold's reference away."""
    return ApiRequest("DELETE", path_of("beam-holds", hold_id, "reference"), d.BeamHold)


def acknowledge_beam_hold(hold_id: str) -> ApiRequest[d.BeamHoldStatus]:
    """Acknowledge a latched hold."""
    return post(d.BeamHoldStatus, "beam-holds", hold_id, "acknowledge")
