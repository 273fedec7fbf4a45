"""Client's methods for beam holds."""

from collections.abc import Mapping
from typing import Any

from lumiline.client.connection import Connection
from lumiline.client.holds import calls
from lumiline.client.holds import documents as d


class HoldMethods(Connection):
    """Beam holds."""

    def holds(self, device_id: str | None = None) -> list[d.Hold]:
        """Beam holds, of a device."""
        return self._all(calls.holds(device_id))

    def hold(self, hold_id: str) -> d.Hold:
        """One beam hold."""
        return self._one(calls.hold(hold_id))

    def create_hold(
        self,
        hold_id: str,
        device_id: str,
        watch: Mapping[str, Any],
        limits: Mapping[str, Any],
        **members: Any,
    ) -> d.Hold:
        """Make a beam hold; ``members`` as in the body of POST /api/v1/holds."""
        return self._one(calls.create_hold(hold_id, device_id, watch, limits, members))

    def change_hold(self, hold_id: str, **members: Any) -> d.Hold:
        """Change a beam hold; ``members`` as in the body of PATCH /api/v1/holds/ID."""
        return self._one(calls.change_hold(hold_id, members))

    def delete_hold(self, hold_id: str) -> None:
        """Delete a beam hold."""
        self.request("DELETE", calls.hold(hold_id).path)

    def hold_state(self, hold_id: str) -> d.HoldState:
        """Whether a beam is held now; to act on it, take the stream's content ``holds``."""
        return self._one(calls.hold_state(hold_id))

    def set_hold_reference(
        self,
        hold_id: str,
        frames: int = 100,
        timeout_s: float = 10.0,
        given: Mapping[str, Any] | None = None,
    ) -> d.Hold:
        """Say that all is where it is to be: the mean of the next frames, or what is given."""
        call = calls.set_hold_reference(hold_id, frames, timeout_s, given)
        return self._one(call, timeout_s)

    def remove_hold_reference(self, hold_id: str) -> d.Hold:
        """Hold the beam until there is another reference."""
        return self._one(calls.remove_hold_reference(hold_id))

    def acknowledge_hold(self, hold_id: str) -> d.HoldState:
        """Let a latched hold end, once all is back."""
        return self._one(calls.acknowledge_hold(hold_id))
