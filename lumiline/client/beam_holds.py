"""Requests about beam holds."""

from collections.abc import Mapping
from typing import Any

from lumiline.client.exchange import ClientMethod, Exchanges
from lumiline.client.models import BeamHold, BeamHoldStatus


class BeamHoldMethods(Exchanges):
    """Requests about beam holds."""

    @ClientMethod
    async def beam_holds(self, device_id: str | None = None) -> list[BeamHold]:
        """Beam holds, of one device."""
        return await self._get_all(BeamHold, "beam-holds", device=device_id)

    @ClientMethod
    async def beam_hold(self, hold_id: str) -> BeamHold:
        """One beam hold."""
        return await self._get(BeamHold, "beam-holds", hold_id)

    @ClientMethod
    async def create_beam_hold(
        self,
        /,
        hold_id: str,
        device_id: str,
        watch: Mapping[str, Any],
        limits: Mapping[str, Any],
        **members: Any,
    ) -> BeamHold:
        """Make a beam hold; ``members`` as in the body of POST /api/v1/beam-holds."""
        own = {"id": hold_id, "device": device_id, "watch": dict(watch), "limits": dict(limits)}
        return await self._send(
            BeamHold, "POST", "beam-holds", body={"title": hold_id, **members, **own}
        )

    @ClientMethod
    async def change_beam_hold(self, /, hold_id: str, **members: Any) -> BeamHold:
        """Change a beam hold; ``members`` as in the body of PATCH /api/v1/beam-holds/ID."""
        return await self._send(BeamHold, "PATCH", "beam-holds", hold_id, body=members)

    @ClientMethod
    async def delete_beam_hold(self, hold_id: str) -> None:
        """Delete a beam hold."""
        await self._delete("beam-holds", hold_id)

    @ClientMethod
    async def beam_hold_state(self, hold_id: str) -> BeamHoldStatus:
        """Whether a beam is held now; to act on it, take the stream's content ``holds``."""
        return await self._get(BeamHoldStatus, "beam-holds", hold_id, "state")

    @ClientMethod
    async def set_beam_hold_reference(
        self,
        hold_id: str,
        frames: int = 100,
        timeout_s: float = 10.0,
        given: Mapping[str, Any] | None = None,
    ) -> BeamHold:
        """Set the pose from which motion is measured.

        Args:
            hold_id: the beam hold.
            frames: how many of the next frames are averaged.
            timeout_s: longest time to wait for them [s].
            given: the reference itself, as in the body of POST /api/v1/beam-holds/ID/reference;
                None: it is measured.
        """
        body = {
            "frames": frames,
            "timeout_s": timeout_s,
            "given": None if given is None else dict(given),
        }
        path = ("beam-holds", hold_id, "reference")
        return await self._send(BeamHold, "POST", *path, body=body, extra_timeout_s=timeout_s)

    @ClientMethod
    async def remove_beam_hold_reference(self, hold_id: str) -> BeamHold:
        """Remove the reference; the beam is held until there is another."""
        return await self._send(BeamHold, "DELETE", "beam-holds", hold_id, "reference")

    @ClientMethod
    async def acknowledge_beam_hold(self, hold_id: str) -> BeamHoldStatus:
        """Release a latched hold once its limits are met again."""
        return await self._send(BeamHoldStatus, "POST", "beam-holds", hold_id, "acknowledge")
