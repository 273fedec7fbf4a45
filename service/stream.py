"""The websocket stream: points and peaks of one device, as they are made."""

import asyncio
from typing import Any

from anyio.to_thread import run_sync
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from starlette.datastructures import QueryParams

from compute.errors import InvalidParameter, LumilineError
from service.errors import UpgradeRequired
from service.live.hub import StreamEnded, Subscription
from service.live.manager import LiveManager
from service.live.messages import CONTENTS, ENCODINGS, Content, Encoding, describe_message, encode
from service.problem_handlers import problem_response
from service.problems import problem_type_of
from service.schema import checked_slug

router = APIRouter()


@router.websocket("/api/v1/stream")
async def stream(websocket: WebSocket) -> None:
    """Send a greeting, then one message for each frame, until the client or the service ends.

    Query: ``device``; ``content``: ``points`` (the default), ``peaks`` or ``points,peaks``;
    ``encoding``: ``msgpack`` (the default, binary frames) or ``json`` (text frames). A request
    that cannot be served is answered with a problem document instead of a websocket.
    """
    try:
        device_id, content, encoding = _request(websocket.query_params)
        await run_sync(websocket.app.state.operation.status, device_id)
    except LumilineError as error:
        path = websocket.url.path
        response = problem_response(problem_type_of(type(error)), error.detail, path)
        await websocket.send_denial_response(response)
        return
    live: LiveManager = websocket.app.state.live
    capacity = websocket.app.state.settings.stream_queue_messages
    await websocket.accept()
    subscription = Subscription(device_id, content, encoding, capacity)
    live.hub.subscribe(subscription)
    try:
        await _send(websocket, encode(_greeting(live, subscription), encoding))
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(_forward(websocket, subscription))
            tasks.create_task(_until_closed(websocket))
    except* WebSocketDisconnect:
        pass
    except* StreamEnded:
        await websocket.close(1001, "the device was deleted")
    finally:
        live.hub.unsubscribe(subscription)


@router.get("/api/v1/stream", include_in_schema=False)
def stream_by_http() -> None:
    """Tell a plain HTTP client what is here."""
    raise UpgradeRequired(
        "this is a websocket: open it as ws://HOST:PORT/api/v1/stream?device=ID, "
        "not as http:// (docs/stream.md describes its messages)"
    )


def _request(query: QueryParams) -> tuple[str, frozenset[Content], Encoding]:
    """Return device, content and encoding of the query; raises InvalidParameter."""
    unknown = sorted(set(query) - {"device", "content", "encoding"})
    if unknown:
        raise InvalidParameter(
            f'the query has "{unknown[0]}"; it may have device, content and encoding'
        )
    if not query.get("device"):
        raise InvalidParameter("the query names no device; add ?device=ID")
    chosen: set[Content] = set()
    for word in query.get("content", "points").split(","):
        match = next((known for known in CONTENTS if known == word), None)
        if match is None:
            raise InvalidParameter(
                f'content has "{word}"; it must be one or more of {", ".join(CONTENTS)}'
            )
        chosen.add(match)
    wanted = query.get("encoding", "msgpack")
    encoding = next((known for known in ENCODINGS if known == wanted), None)
    if encoding is None:
        raise InvalidParameter(f'encoding is "{wanted}"; it must be {" or ".join(ENCODINGS)}')
    return checked_slug(query["device"]), frozenset(chosen), encoding


def _greeting(live: LiveManager, subscription: Subscription) -> dict[str, Any]:
    """Return the first message: what will come, and how things stand."""
    description = live.describe(subscription.device_id)
    status = live.status(subscription.device_id)
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
        "device": subscription.device_id,
        "content": sorted(subscription.content),
        **(describe_message(description) if description else unknown),
        "state": status.state,
        "reason": status.reason,
        "calibration": status.calibration_id,
    }


async def _forward(websocket: WebSocket, subscription: Subscription) -> None:
    while True:
        await _send(websocket, await subscription.next())


async def _until_closed(websocket: WebSocket) -> None:
    """Read and ignore what the client sends; raises WebSocketDisconnect when it is gone."""
    while True:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", 1005))


async def _send(websocket: WebSocket, payload: bytes | str) -> None:
    try:
        if isinstance(payload, bytes):
            await websocket.send_bytes(payload)
        else:
            await websocket.send_text(payload)
    except RuntimeError as error:
        # The server closed the connection meanwhile (no answer to its pings, or it shuts down).
        raise WebSocketDisconnect(1006) from error
