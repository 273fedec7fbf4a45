"""Requests about beam holds, for both clients."""

from collections.abc import Mapping
from typing import Any

from lumiline.client.call import Call, get, path_of, post
from lumiline.client.holds import documents as d


def holds(device_id: str | None) -> Call[d.Hold]:
    """Beam holds."""
    return get(d.Hold, "holds", device=device_id)


def hold(hold_id: str) -> Call[d.Hold]:
    """One beam hold."""
    return get(d.Hold, "holds", hold_id)


def create_hold(
    hold_id: str,
    device_id: str,
    watch: Mapping[str, Any],
    limits: Mapping[str, Any],
    members: Mapping[str, Any],
) -> Call[d.Hold]:
    """Make a beam hold."""
    own = {"id": hold_id, "device": device_id, "watch": dict(watch), "limits": dict(limits)}
    return post(d.Hold, "holds", body={"title": hold_id, **members, **own})


def change_hold(hold_id: str, members: Mapping[str, Any]) -> Call[d.Hold]:
    """Change a beam hold."""
    return Call("PATCH", path_of("holds", hold_id), d.Hold, body=dict(members))


def hold_state(hold_id: str) -> Call[d.HoldState]:
    """Whether a beam is held now."""
    return get(d.HoldState, "holds", hold_id, "state")


def set_hold_reference(
    hold_id: str, frames: int, timeout_s: float, given: Mapping[str, Any] | None
) -> Call[d.Hold]:
    """Measure a hold's reference, or give it."""
    body = {
        "frames": frames,
        "timeout_s": timeout_s,
        "given": None if given is None else dict(given),
    }
    return post(d.Hold, "holds", hold_id, "reference", body=body)


def remove_hold_reference(hold_id: str) -> Call[d.Hold]:
    """Take a hold's reference away."""
    return Call("DELETE", path_of("holds", hold_id, "reference"), d.Hold)


def acknowledge_hold(hold_id: str) -> Call[d.HoldState]:
    """Acknowledge a latched hold."""
    return post(d.HoldState, "holds", hold_id, "acknowledge")
