"""The websocket stream: points and peaks of one device, as they are made."""

import asyncio
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final

from anyio.to_thread import run_sync
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from starlette.datastructures import State

from compute.errors import LumilineError
from service.errors import NotReady, UpgradeRequired
from service.live.hold_now import hold_part
from service.live.manager import LiveManager
from service.live.messages import describe_message, encode
from service.live.subscription import StreamEnded, Subscription, Wanted
from service.problem_handlers import problem_response
from service.problems import problem_type_of
from service.security.credential import SUBPROTOCOL, subprotocols
from service.security.guard import ACT
from service.security.principal import Principal
from service.stream_query import wanted_of

if TYPE_CHECKING:
    from service.security.authenticator import Authenticator
    from service.security.open_streams import OpenStreams

router = APIRouter()

CHECKED_EVERY_S: Final = 2.0
"""How often an open stream is checked against its key's revocation and end."""


@router.websocket("/api/v1/stream")
async def stream(websocket: WebSocket) -> None:
    """Send a greeting, then frames and status messages, until the client or the service ends.

    Query: see ``service.stream_query`` and docs/stream.md. A request that cannot be served is
    answered with a problem document instead of a websocket.
    """
    principal: Principal = websocket.scope[ACT].principal
    with ExitStack() as stack:
        try:
            wanted = wanted_of(websocket.query_params)
            await run_sync(websocket.app.state.operation.status, wanted.device_id)
            stack.enter_context(websocket.app.state.open_streams.one_more(principal))
        except LumilineError as error:
            path = websocket.url.path
            response = problem_response(problem_type_of(type(error)), error.detail, path)
            await websocket.send_denial_response(response)
            return
        await _serve(websocket, wanted, principal)


async def _serve(websocket: WebSocket, wanted: Wanted, principal: Principal) -> None:
    live: LiveManager = websocket.app.state.live
    offered = subprotocols(websocket.headers)
    await websocket.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
    subscription = live.hub.subscribe(wanted)
    try:
        await _send(websocket, encode(_greeting(live, subscription), wanted.encoding))
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(_forward(websocket, subscription))
            tasks.create_task(_until_closed(websocket))
            tasks.create_task(_until_ended(websocket.app.state, principal))
    except* WebSocketDisconnect:
        pass
    except* _NotAllowedAnyMore as ended:
        await websocket.close(1008, str(ended.exceptions[0]))
    except* StreamEnded as ended:
        await websocket.close(1001, str(ended.exceptions[0]))
    finally:
        live.hub.unsubscribe(subscription)


@router.get("/api/v1/stream", include_in_schema=False)
def stream_by_http() -> None:
    """Tell a plain HTTP client what is here."""
    raise UpgradeRequired(
        "this is a websocket: open it as ws://HOST:PORT/api/v1/stream?device=ID, "
        "not as http:// (docs/stream.md describes its messages)"
    )


def _greeting(live: LiveManager, subscription: Subscription) -> dict[str, Any]:
    """Return the first message: what will come, and how things stand."""
    wanted = subscription.wanted
    description = live.describe(wanted.device_id)
    status = live.status(wanted.device_id)
    unknown: dict[str, Any] = {
        "sensors": [],
        "frame_rate_hz": None,
        "markers": None,
        "readout": None,
        "method": None,
    }
    return {
        "type": "hello",
        "version": 1,
        "device": wanted.device_id,
        "content": sorted(wanted.content),
        "mode": "lossless" if wanted.lossless else "live",
        "stream": subscription.log.id,
        "next": subscription.start,
        "resumed": subscription.resumed,
        **(describe_message(description) if description else unknown),
        "state": status.state,
        "reason": status.reason,
        "link": status.link.state if status.link else None,
        "calibration": status.calibration_id,
        **_holds(live, wanted),
    }


def _holds(live: LiveManager, wanted: Wanted) -> dict[str, Any]:
    """Return how beam holds stand, for who asked for them: frames may never come."""
    if "holds" not in wanted.content:
        return {}
    return {"holds": [hold_part(now) for now in live.holds.of_device(wanted.device_id)]}


async def _forward(websocket: WebSocket, subscription: Subscription) -> None:
    while True:
        await _send(websocket, await subscription.next())


async def _until_closed(websocket: WebSocket) -> None:
    """Read and ignore what the client sends; raises WebSocketDisconnect when it is gone."""
    while True:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", 1005))


class _NotAllowedAnyMore(Exception):
    """The key or token of a stream has expired or was revoked."""


async def _until_ended(state: State, principal: Principal) -> None:
    """Raise _NotAllowedAnyMore once a key is revoked or anything expires."""
    authenticator: Authenticator = state.authenticator
    streams: OpenStreams = state.open_streams
    while principal.kind != "local":
        await asyncio.sleep(CHECKED_EVERY_S)
        try:
            reason = await run_sync(authenticator.why_ended, principal, limiter=streams.checks)
        except NotReady:
            continue  # a database that does not answer must not end a measurement
        if reason is not None:
            raise _NotAllowedAnyMore(reason)


async def _send(websocket: WebSocket, payload: bytes | str) -> None:
    try:
        if isinstance(payload, bytes):
            await websocket.send_bytes(payload)
        else:
            await websocket.send_text(payload)
    except RuntimeError as error:
        # The server closed the connection meanwhile (no answer to its pings, or it shuts down).
        raise WebSocketDisconnect(1006) from error
