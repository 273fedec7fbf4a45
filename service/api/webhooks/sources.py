"""Events of webhooks: changes of beam holds as they come, of devices by a look each second."""

import logging
from collections.abc import Callable
from threading import Event, Thread
from typing import Any, Final

from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import BeamHoldState
from service.pipeline.interface import Pipeline

_log = logging.getLogger(__name__)

LOOK_S: Final = 1.0
_LOST: Final = ("disconnected", "failed")

Emit = Callable[[str, dict[str, Any]], None]


class HoldEvents:
    """Listener of the beam holds: emits when a hold begins or ends, not how it is at the start."""

    def __init__(self, emit: Emit) -> None:
        self._emit = emit
        self._held: dict[str, bool] = {}

    def __call__(self, device_id: str, state: BeamHoldState, last: bool) -> None:
        """Take a change; called with the registry's lock held, so it returns at once."""
        before = self._held.get(state.hold_id)
        self._held[state.hold_id] = state.held
        if last:
            del self._held[state.hold_id]
        if before is None or before == state.held:
            return
        data = {
            "device_id": device_id,
            "hold_id": state.hold_id,
            "cause": state.cause,
            "reason": state.reason,
        }
        self._emit("hold.held" if state.held else "hold.released", data)


class DeviceEvents:
    """Emits when a running device is lost, and when a lost one runs again."""

    def __init__(self, emit: Emit) -> None:
        self._emit = emit
        self._lost: dict[str, bool] = {}

    def look(self, statuses: dict[str, DeviceStatus]) -> None:
        """Compare with the last look; a device that was stopped or ends is not lost."""
        for device_id, status in statuses.items():
            before = self._lost.get(device_id)
            if status.state == "running":
                self._lost[device_id] = False
                if before:
                    self._emit("device.recovered", {"device_id": device_id})
            elif status.state in _LOST and before is not None:
                self._lost[device_id] = True
                if not before:
                    self._emit(
                        "device.lost",
                        {
                            "device_id": device_id,
                            "state": status.state,
                            "reason": status.reason,
                        },
                    )
            elif status.state in ("stopped", "ended"):
                self._lost.pop(device_id, None)
        for gone in self._lost.keys() - statuses.keys():
            del self._lost[gone]


class EventSources:
    """Watches holds and devices of a server until it is closed.

    Args:
        live: the live pipeline.
        emit: takes the events.
        look_s: how often it looks how devices stand.
        is_mine: whether this server tells of a device, of several that may see it.
    """

    def __init__(
        self,
        live: Pipeline,
        emit: Emit,
        look_s: float = LOOK_S,
        is_mine: Callable[[str], bool] = lambda _: True,
    ) -> None:
        def emit_mine(event_type: str, data: dict[str, Any]) -> None:
            if is_mine(data["device_id"]):
                emit(event_type, data)

        self._live = live
        self._look_s = look_s
        self._devices = DeviceEvents(emit_mine)
        self._end_holds = live.holds.listen(HoldEvents(emit_mine))
        self._ended = Event()
        self._thread = Thread(target=self._run, name="webhook events", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it."""
        self._end_holds()
        self._ended.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        while not self._ended.wait(self._look_s):
            try:
                self._devices.look(self._live.statuses())
            except Exception:  # noqa: BLE001 - the next look may work
                _log.exception("devices are not looked at for webhooks now")
