"""The websocket endpoint: results of one device's frames, as they are made."""

import asyncio
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Any, Final

from anyio.to_thread import run_sync
from fastapi import APIRouter, Depends, WebSocket, WebSocketDisconnect
from starlette.datastructures import State

from compute.errors import LumilineError
from service.pipeline.interface import Pipeline
from service.principal import Principal
from service.problems.catalogue import problem_type_of
from service.problems.errors import NotReady, UpgradeRequired
from service.problems.handlers import problem_response
from service.protocols.stream.hub import Hub, StreamEnded, StreamRequest, Subscription
from service.protocols.stream.messages import Payload, describe_message, encode, hold_members
from service.protocols.stream.query import StreamQuery, parse_stream_request
from service.security.credential import SUBPROTOCOL, subprotocols
from service.security.guard import ACT

if TYPE_CHECKING:
    from service.security.authenticator import Authenticator
    from service.security.stream_limit import StreamLimit

router = APIRouter()
StreamQueryDep = Annotated[StreamQuery, Depends()]

ACCESS_CHECK_INTERVAL_S: Final = 2.0
"""How often an open stream is checked against its key's revocation and end."""
TURN_BYTES: Final = 32 * 1024
"""What one client is sent before it is the turn of others; at least one message."""
SEND_MANY: Final = "lumiline.send_many"
"""Extension of ASGI: its ``send`` writes a list of payloads in one go."""


@router.websocket("/api/v1/stream")
async def stream(websocket: WebSocket, query: StreamQueryDep) -> None:
    """Send a greeting, then frames and status messages, until the client or the service ends.

    Query: see ``service.protocols.stream.query`` and docs/reference/stream.md. A request that
    cannot be served is answered with a problem document instead of a websocket.
    """
    principal: Principal = websocket.scope[ACT].principal
    with ExitStack() as stack:
        try:
            request = parse_stream_request(query.given())
            await run_sync(websocket.app.state.device_service.status, request.device_id)
            stack.enter_context(websocket.app.state.open_streams.opened(principal))
        except LumilineError as error:
            path = websocket.url.path
            response = problem_response(problem_type_of(type(error)), error.detail, path)
            await websocket.send_denial_response(response)
            return
        await _serve(websocket, request, principal)


async def _serve(websocket: WebSocket, request: StreamRequest, principal: Principal) -> None:
    live: Pipeline = websocket.app.state.live
    hub: Hub = websocket.app.state.streams
    client_protocols = subprotocols(websocket.headers)
    await websocket.accept(SUBPROTOCOL if SUBPROTOCOL in client_protocols else None)
    subscription = hub.subscribe(request, principal.label)
    try:
        await _send(websocket, encode(_greeting(live, subscription), request.encoding))
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(_forward(websocket, subscription))
            tasks.create_task(_until_closed(websocket))
            tasks.create_task(_until_ended(websocket.app.state, principal))
    except* WebSocketDisconnect:
        pass
    except* _AccessRevoked as ended:
        await websocket.close(1008, str(ended.exceptions[0]))
    except* StreamEnded as ended:
        await websocket.close(1001, str(ended.exceptions[0]))
    finally:
        hub.unsubscribe(subscription)


@router.get("/api/v1/stream", include_in_schema=False)
def stream_by_http(_query: StreamQueryDep) -> None:
    """Answer a plain HTTP request: 426, this is a websocket."""
    raise UpgradeRequired(
        "this is a websocket: open it as ws://HOST:PORT/api/v1/stream?device_id=ID, "
        "not as http:// (docs/reference/stream.md describes its messages)"
    )


def _greeting(live: Pipeline, subscription: Subscription) -> dict[str, Any]:
    """Return the first message: what will come, and how things stand."""
    request = subscription.request
    status = live.status(request.device_id)
    greeting = {
        "type": "hello",
        "version": 1,
        "device_id": request.device_id,
        "content": sorted(request.content),
        "mode": "lossless" if request.lossless else "live",
        "stream": subscription.log.id,
        "next": subscription.start,
        "resumed": subscription.resumed,
        **describe_message(live.describe(request.device_id)),
        "state": status.state,
        "reason": status.reason,
        "link": status.link.state if status.link else None,
        "calibration_id": status.calibration_id,
        "radiometric_id": status.radiometric_id,
    }
    if "holds" in request.content:  # frames, which tell of them too, may never come
        holds = live.holds.of_device(request.device_id)
        greeting["holds"] = [hold_members(now) for now in holds]
    return greeting


async def _forward(websocket: WebSocket, subscription: Subscription) -> None:
    """Send waiting messages, a bounded number in each turn: the loop serves others, too."""
    while True:
        payloads = [await subscription.next()]
        size = len(payloads[0])
        while size < TURN_BYTES and (more := subscription.next_at_once()) is not None:
            payloads.append(more)
            size += len(more)
        await _send_many(websocket, payloads)
        await asyncio.sleep(0)


async def _until_closed(websocket: WebSocket) -> None:
    """Read and ignore what the client sends; raises WebSocketDisconnect when it is gone."""
    while True:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", 1005))


class _AccessRevoked(Exception):
    """The key or token of a stream has expired or was revoked."""


async def _until_ended(state: State, principal: Principal) -> None:
    """Raise _AccessRevoked once a key is revoked or anything expires."""
    authenticator: Authenticator = state.authenticator
    streams: StreamLimit = state.open_streams
    while principal.kind != "local":
        await asyncio.sleep(ACCESS_CHECK_INTERVAL_S)
        try:
            reason = await run_sync(authenticator.why_ended, principal, limiter=streams.checks)
        except NotReady:
            continue  # a database that does not answer must not end a measurement
        if reason is not None:
            raise _AccessRevoked(reason)


async def _send_many(websocket: WebSocket, payloads: list[Payload]) -> None:
    """Send payloads in one write, and by the shortest way, where the server can."""
    server = websocket.scope.get("extensions", {}).get(SEND_MANY)
    if server is None:
        for payload in payloads:
            await _send(websocket, payload)
        return
    try:
        await server["send"](payloads)
    except OSError as error:
        raise WebSocketDisconnect(1006) from error


async def _send(websocket: WebSocket, payload: bytes | str) -> None:
    try:
        if isinstance(payload, bytes):
            await websocket.send_bytes(payload)
        else:
            await websocket.send_text(payload)
    except RuntimeError as error:
        # The server closed the connection meanwhile (no answer to its pings, or it shuts down).
        raise WebSocketDisconnect(1006) from error
