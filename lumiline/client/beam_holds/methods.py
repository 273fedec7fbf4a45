"""Client's methods for beam holds."""

from collections.abc import Mapping
from typing import Any

from lumiline.client.beam_holds import models as d
from lumiline.client.beam_holds import requests
from lumiline.client.connection import Connection


class BeamHoldMethods(Connection):
    """Beam holds."""

    def beam_holds(self, device_id: str | None = None) -> list[d.BeamHold]:
        """Beam holds, of a device."""
        return self._all(requests.beam_holds(device_id))

    def beam_hold(self, hold_id: str) -> d.BeamHold:
        """One beam hold."""
        return self._one(requests.beam_hold(hold_id))

    def create_beam_hold(
        self,
        hold_id: str,
        device_id: str,
        watch: Mapping[str, Any],
        limits: Mapping[str, Any],
        **members: Any,
    ) -> d.BeamHold:
        """Make a beam hold; ``members`` as in the body of POST /api/v1/beam-holds."""
        return self._one(requests.create_beam_hold(hold_id, device_id, watch, limits, members))

    def change_beam_hold(self, hold_id: str, **members: Any) -> d.BeamHold:
        """Change a beam hold; ``members`` as in the body of PATCH /api/v1/beam-holds/ID."""
        return self._one(requests.change_beam_hold(hold_id, members))

    def delete_beam_hold(self, hold_id: str) -> None:
        """Delete a beam hold."""
        self.request("DELETE", requests.beam_hold(hold_id).path)

    def beam_hold_state(self, hold_id: str) -> d.BeamHoldStatus:
        """Whether a beam is held now; to act on it, take the stream's content ``holds``."""
        return self._one(requests.beam_hold_state(hold_id))

    def set_beam_hold_reference(
        self,
        hold_id: str,
        frames: int = 100,
        timeout_s: float = 10.0,
        given: Mapping[str, Any] | None = None,
    ) -> d.BeamHold:
        """Say that all is where it is to be: the mean of the next frames, or what is given."""
        call = requests.set_beam_hold_reference(hold_id, frames, timeout_s, given)
        return self._one(call, timeout_s)

    def remove_beam_hold_reference(self, hold_id: str) -> d.BeamHold:
        """Hold the beam until there is another reference."""
        return self._one(requests.remove_beam_hold_reference(hold_id))

    def acknowledge_beam_hold(self, hold_id: str) -> d.BeamHoldStatus:
        """Let a latched hold end, once all is back."""
        return self._one(requests.acknowledge_beam_hold(hold_id))
