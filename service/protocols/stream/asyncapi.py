"""AsyncAPI document of the stream, from the types of its messages, served beside the OpenAPI one.

The types are the client's, which are compared with real messages; members that a message always has
are required, others may be absent where their content was not asked for.
"""

import inspect
from dataclasses import MISSING, fields
from functools import cache
from typing import Any, Final

from fastapi import APIRouter
from pydantic import TypeAdapter
from starlette.responses import JSONResponse

from service.protocols.stream.messages import CONTENTS, ENCODINGS
from service.protocols.stream.query import MODES, STATE
from service.version import package_version

router = APIRouter()

_REFERENCE: Final = "#/components/schemas/{model}"
PATH: Final = "/api/v1/asyncapi.json"
_KINDS: Final[dict[str, tuple[str, str]]] = {
    "hello": ("Hello", "The first message of each connection."),
    "frame": ("Frame", "One for each exposure."),
    "state": ("DeviceState", "The device's state has changed."),
    "hold": ("BeamHoldEvent", "A beam hold begins, ends, or changes its cause."),
    "missed": ("Missed", "Messages that this client was too slow for."),
}
"""By ``type`` of the message the client's class, and what it tells."""
_QUERY: Final[dict[str, dict[str, Any]]] = {
    "device_id": {"type": "string", "description": "The device's id."},
    "content": {
        "type": "string",
        "description": f"What frames hold, separated by commas: {', '.join(CONTENTS)}; {STATE}: "
        "no frames. By default points.",
        "examples": ["points", "tools,holds"],
    },
    "encoding": {
        "type": "string",
        "enum": list(ENCODINGS),
        "description": "By default msgpack, in binary messages; json, in text messages.",
    },
    "mode": {
        "type": "string",
        "enum": list(MODES),
        "description": "live: the newest frames; lossless: every message.",
    },
    "rate_hz": {"type": "number", "description": "Highest rate of frames [Hz], with live."},
    "bundle_ms": {"type": "number", "description": "Frames of this time are sent together [ms]."},
    "stream": {"type": "string", "description": "With lossless: the stream's id, to go on in it."},
    "after": {
        "type": "integer",
        "description": "With stream: number of the last message you have.",
    },
}


@router.get(PATH, include_in_schema=False, name="asyncapi")
def get_asyncapi() -> JSONResponse:
    """Answer the AsyncAPI document of the stream."""
    return JSONResponse(document())


@cache
def document() -> dict[str, Any]:
    """Return the AsyncAPI 3.0 document of the stream."""
    # Only here: the client brings its libraries of HTTP and websockets.
    from lumiline.client import messages

    schemas: dict[str, Any] = {}
    for kind, (name, _) in _KINDS.items():
        schema = TypeAdapter(getattr(messages, name)).json_schema(ref_template=_REFERENCE)
        schema["properties"] = {"type": {"const": kind}, **schema["properties"]}
        parts = schema.pop("$defs", {}) | {name: schema}
        for part, found in parts.items():
            schemas[part] = _described(found, getattr(messages, part))
        schema["required"].insert(0, "type")
    schemas["Frames"] = {
        "type": "object",
        "description": "Frames of a while together, with `bundle_ms`.",
        "required": ["type", "device_id", "frames"],
        "properties": {
            "type": {"const": "frames"},
            "device_id": {"type": "string"},
            "frames": {"type": "array", "items": {"$ref": "#/components/schemas/Frame"}},
        },
    }
    kinds = {**_KINDS, "frames": ("Frames", "Frames of a while together, with `bundle_ms`.")}
    names = list(kinds)
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "Lumiline: the stream",
            "version": package_version(),
            "description": "Measurements of a device in real time. Lengths are in mm, angles in "
            "rad, times in ns since 1970 UTC; a member that a client does not know is to be "
            "ignored, as is a message of an unknown type.",
        },
        "defaultContentType": "application/msgpack",
        "servers": {
            "local": {
                "host": "localhost:8000",
                "protocol": "ws",
                "description": "A server as it starts without settings.",
                "security": [{"$ref": "#/components/securitySchemes/key"}],
            }
        },
        "channels": {
            "stream": {
                "address": "/api/v1/stream",
                "description": "A websocket; the query says which device, and what of it.",
                "messages": {name: {"$ref": f"#/components/messages/{name}"} for name in names},
                "bindings": {
                    "ws": {
                        "method": "GET",
                        "query": {
                            "type": "object",
                            "required": ["device_id"],
                            "properties": _QUERY,
                            "additionalProperties": False,
                        },
                    }
                },
            }
        },
        "operations": {
            "receive": {
                "action": "send",
                "summary": "The server sends; clients send nothing.",
                "channel": {"$ref": "#/channels/stream"},
                "messages": [{"$ref": f"#/channels/stream/messages/{name}"} for name in names],
            }
        },
        "components": {
            "messages": {
                name: {
                    "name": name,
                    "summary": text,
                    "payload": {"$ref": f"#/components/schemas/{schema}"},
                }
                for name, (schema, text) in kinds.items()
            },
            "schemas": dict(sorted(schemas.items())),
            "securitySchemes": {
                "key": {
                    "type": "http",
                    "scheme": "bearer",
                    "description": "With the handshake; browsers offer the subprotocols "
                    "`lumiline.v1` and `lumiline.bearer.KEY`. Needs scope `read:stream`.",
                }
            },
        },
    }


def _described(schema: dict[str, Any], model: type[Any]) -> dict[str, Any]:
    schema["description"] = inspect.cleandoc(model.__doc__ or "").replace("``", "`")
    schema["required"] = [one.name for one in fields(model) if one.default is MISSING]
    for member in schema["properties"].values():
        # A default is what the client takes of an older server.
        member.pop("default", None)
        member.pop("title", None)
    schema.pop("title", None)
    return schema
