"""The OpenAPI document: problem responses by their types, and the shared schemas."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

from fastapi import APIRouter, FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema

from service.api import idempotency
from service.api.inputs import JsonRoute
from service.api.member_descriptions import describe_members
from service.api.preconditions import (
    ETAG_HEADER,
    IF_MATCH_SCHEMA,
    IF_NONE_MATCH,
    NOT_MODIFIED,
    has_etag,
)
from service.principal import SCOPE_MEANINGS
from service.problems.catalogue import (
    MEDIA_TYPE,
    PROBLEM_TYPES,
    Problem,
    ProblemType,
)
from service.security.operation_scopes import OPERATION_SCOPES, PUBLIC

ANSWER_EXAMPLES: Final = Path(__file__).with_name("answer_examples.json")
"""Answers that a server gave, by operation; recorded by ``tests.service.api.record_answers``."""
_CREATED: Final = (201, 202)

Responses = dict[int | str, dict[str, Any]]
Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])

_OF_RESOURCES: Final = ("not-ready",)
_OF_RUNNING_DEVICES: Final = "device-not-running"
_OF_DEVICES_ELSEWHERE: Final = "device-elsewhere"
"""Of whatever needs a running device, where several gateways have one database."""
_OF_ALL_REQUESTS: Final = ("credential-in-query", "query-too-long", "unknown-query-member")
_OF_THOSE_WITH_SCOPE: Final = ("unauthenticated", "missing-scope", "too-many-attempts")
_OF_CHANGES: Final = ("cross-origin",)
_OF_STORED_CHANGES: Final = ("database-full", "insufficient-storage")
_OF_BODIES: Final = (
    *("malformed-json", "duplicate-key", "unsupported-media-type"),
    *("body-too-large", "body-too-slow", "non-finite-value"),
)

_SCHEME: Final = "key"
_SCHEMES: Final = {
    _SCHEME: {
        "type": "http",
        "scheme": "bearer",
        "description": "`Authorization: Bearer lumi_...`: an API key, or a token of the identity "
        "provider where one is set up. On the server's own machine none is needed, unless the "
        "server is told to require one. What each scope allows: "
        + "; ".join(f"`{scope}`: {meaning}" for scope, meaning in SCOPE_MEANINGS.items())
        + ".",
    }
}

_TAGS: Final = {
    "devices": "What is read, by which driver, and what it is doing.",
    "calibrations": "Camera models from control points. Immutable: create, read, activate, retire.",
    "captures": "Guided measurement: place a marker, hold it, capture it, go to the next; or wave "
    "a wand, and see what is covered.",
    "radiometric-calibrations": "Offset, response, noise and bad pixels of the sensors, from dark "
    "and flat captures. Immutable: capture, create, activate.",
    "drift-checks": "Is a calibration still good? Still markers read again, kept over time.",
    "quality": "Quick checks with known points and distances, a watch on drift, charts.",
    "correction-tables": "Maps of space: what is added to the readings, by where the marker is.",
    "runs": "Calibrations and maps computed beside the requests: post, follow, cancel.",
    "reconstructions": "3D points from readings that you post.",
    "tools": "Rigid tools with markers: geometry, tip, poses, registration to images.",
    "beam-holds": "Beam holds: a signal when a patient leaves the tolerance.",
    "recordings": "Line scans and results of running devices in files, to be replayed.",
    "line-scans": "Peaks of lines that you post, and their picture.",
    "device-profiles": "Tracking devices as published, and what they would reach: planning before "
    "building.",
    "keys": "Who may do what, and who did what.",
    "webhooks": "Where events of holds, devices and drift are sent.",
    "server": "Health, and what problem types mean.",
    "stations": "Processes that devices belong to, on this machine and on others.",
}


class ResourceRouter(APIRouter):
    """Operations of a resource: strict JSON bodies, problems in the OpenAPI document.

    Args:
        prefix: of the paths.
        tag: of the operations.
    """

    def __init__(self, prefix: str, tag: str) -> None:
        super().__init__(prefix=prefix, tags=[tag], route_class=JsonRoute)

    def operation(
        self,
        route: str,
        operation_id: str,
        summary: str,
        *,
        responses: Responses | None = None,
        idempotent: bool = True,
        **options: Any,
    ) -> Callable[[Endpoint], Endpoint]:
        """Return a decorator that adds an operation; ``raises`` below it names its problems.

        Args:
            route: method of HTTP and path below the prefix, such as ``GET /{run_id}``; an endpoint
                that returns None is answered with 204.
            operation_id: its name in the OpenAPI document and the table of scopes.
            summary: of the document.
            responses: other answers of the document.
            idempotent: whether a POST that creates takes an Idempotency-Key, by which its answer is
                kept for a day.
            options: as of ``APIRouter.add_api_route``.
        """
        method, _, path = route.partition(" ")

        def add(endpoint: Endpoint) -> Endpoint:
            if endpoint.__annotations__["return"] is None:
                options.setdefault("status_code", 204)
            codes: Sequence[str] = getattr(endpoint, "problems", ())
            if _OF_RUNNING_DEVICES in codes:
                codes = (*codes, _OF_DEVICES_ELSEWHERE)
            answers = responses or {}
            if method == "POST" and idempotent and options.get("status_code") in _CREATED:
                codes = (*codes, *idempotency.PROBLEMS)
                extra = options.get("openapi_extra", {})
                options["openapi_extra"] = {**extra, "parameters": [idempotency.PARAMETER]}
            answer = options.get("response_model", endpoint.__annotations__["return"])
            if has_etag(method, f"{self.prefix}{path}", answer):
                answers = {**answers, 200: {"headers": ETAG_HEADER, **answers.get(200, {})}}
                if method == "GET":
                    answers[304] = NOT_MODIFIED
                    options["openapi_extra"] = {"parameters": [IF_NONE_MATCH]}
            self.add_api_route(
                path,
                endpoint,
                methods=[method],
                operation_id=operation_id,
                summary=summary,
                responses=_responses(codes) | answers,
                **options,
            )
            return endpoint

        return add


def raises(*codes: str) -> Callable[[Endpoint], Endpoint]:
    """Return a decorator that names problems of an endpoint, beside those of its input and scope.

    Args:
        codes: of the problem types, as the OpenAPI document and problem documents have them.
    """

    def add(endpoint: Endpoint) -> Endpoint:
        before = getattr(endpoint, "problems", ())
        endpoint.problems = (*codes, *before)  # type: ignore[attr-defined]
        return endpoint

    return add


def _responses(codes: Iterable[str]) -> Responses:
    by_status: dict[int, dict[str, ProblemType]] = defaultdict(dict)
    for code in codes:
        kind = PROBLEM_TYPES[code]
        by_status[kind.status][code] = kind
    return {
        status: {
            "description": "; ".join(f"`{code}`: {kind.meaning}" for code, kind in found.items()),
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
        for status, found in sorted(by_status.items())
    }


def install_openapi(app: FastAPI) -> None:
    """Let the application serve the completed document."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = _document(app)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _document(app: FastAPI) -> dict[str, Any]:
    document = get_openapi(
        title=app.title,
        version=app.version,
        summary=app.summary,
        description=app.description,
        tags=[{"name": name, "description": text} for name, text in _TAGS.items()],
        routes=app.routes,
    )
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    _, found = models_json_schema(
        [(Problem, "serialization")], ref_template="#/components/schemas/{model}"
    )
    schemas |= found["$defs"]
    describe_members(schemas)
    _require_discriminators(schemas, schemas)
    document["components"]["securitySchemes"] = _SCHEMES
    for path, item in document["paths"].items():
        for method, operation in item.items():
            if method != "parameters":
                _add_answer_example(operation)
                of_path = _OF_RESOURCES if path.startswith("/api/") else ()
                changes = () if method == "get" else (*_OF_CHANGES, *_OF_STORED_CHANGES)
                others = [*_OF_ALL_REQUESTS, *of_path, *changes]
                _complete(operation, [*others, *_secure(operation)])
    return document


def _add_answer_example(operation: dict[str, Any]) -> None:
    """Add a recorded answer to the success of an operation that answers JSON."""
    example = _answer_examples().get(operation["operationId"])
    for status, response in operation["responses"].items():
        content = response.get("content", {}).get("application/json")
        if example is not None and status.startswith("2") and content is not None:
            content["example"] = example


@cache
def _answer_examples() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(ANSWER_EXAMPLES.read_text(encoding="utf-8"))
    return found


def _secure(operation: dict[str, Any]) -> tuple[str, ...]:
    """Document the scope that an operation needs; return the problems that follow."""
    scope = OPERATION_SCOPES[operation["operationId"]]
    if scope == PUBLIC:
        operation["security"] = []
        return ()
    operation["security"] = [{_SCHEME: [scope]}]
    operation["description"] = (
        f"{operation.get('description', '')}\n\nNeeds scope `{scope}`.".strip()
    )
    return _OF_THOSE_WITH_SCOPE


def _require_discriminators(node: Any, schemas: dict[str, Any]) -> None:
    """Make the discriminator of each union a required property, also where it has a default.

    A default serves Python; a document without the property cannot be told apart and is refused.
    """
    if isinstance(node, dict):
        discriminator = node.get("discriminator")
        if isinstance(discriminator, dict) and "mapping" in discriminator:
            name = discriminator["propertyName"]
            for reference in discriminator["mapping"].values():
                required = schemas[reference.rpartition("/")[2]].setdefault("required", [])
                if name not in required:
                    required.append(name)
        for value in node.values():
            _require_discriminators(value, schemas)
    elif isinstance(node, list):
        for value in node:
            _require_discriminators(value, schemas)


def _complete(operation: dict[str, Any], others: Sequence[str]) -> None:
    """Add the problems of every operation, ``others``, and those that follow from its input."""
    responses = operation["responses"]
    codes = ["internal-error", *others]
    if responses.get("422", {}).get("content", {}).get("application/json"):
        del responses["422"]  # FastAPI's own description of validation errors
    if operation.get("requestBody") or operation.get("parameters"):
        codes.append("invalid-request")
    if operation.get("requestBody"):
        codes += _OF_BODIES
    for parameter in operation.get("parameters", ()):
        if parameter["name"] == "If-Match":
            parameter |= {"required": "428" in responses, "schema": IF_MATCH_SCHEMA}
    for status, response in _responses(codes).items():
        given = responses.get(str(status))
        if given is None:
            responses[str(status)] = response
        elif response["description"] not in given["description"]:
            given["description"] += "; " + response["description"]
    operation["responses"] = dict(sorted(responses.items()))
