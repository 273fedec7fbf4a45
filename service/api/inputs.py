"""What endpoints take: parts of the application, JSON bodies, ids, filters and pages."""

import email.message
import json
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Final, TypeVar

from anyio.to_thread import run_sync
from fastapi import Depends, Path, Query, Request
from fastapi.routing import APIRoute
from pydantic import (
    GetCoreSchemaHandler,
    TypeAdapter,
    ValidationError,
    ValidatorFunctionWrapHandler,
)
from pydantic_core import CoreSchema, ErrorDetails, core_schema
from sqlalchemy import Select, func
from sqlalchemy.orm import Session
from starlette.responses import Response

from service.api.base_models import SLUG_PATTERN, Page
from service.database.engine import Database
from service.jobs.run_manager import RunManager
from service.pipeline.pipeline_manager import PipelineManager
from service.problems.errors import (
    BodyTooLarge,
    DuplicateKey,
    MalformedJson,
    NotReady,
    UnsupportedMediaType,
)
from service.settings import Settings


def of_application(name: str) -> Any:
    """Return the dependency on a part of the application, by its name in ``app.state``."""

    def part(request: Request) -> Any:
        return getattr(request.app.state, name)

    return Depends(part)


def _live(request: Request) -> PipelineManager:
    live: PipelineManager | None = request.app.state.live
    if live is None:
        raise NotReady("the live pipeline does not run; restart the server", part="live")
    return live


DatabaseDep = Annotated[Database, of_application("database")]
LiveDep = Annotated[PipelineManager, Depends(_live)]
RunsDep = Annotated[RunManager, of_application("runs")]
SettingsDep = Annotated[Settings, of_application("settings")]


def id_in_path(
    description: str, example: str, name: str, summary: str = "of the example body"
) -> Any:
    """Return the parameter of a path that is an id.

    Args:
        description: what it is the id of.
        example: an id that works on a new server, or with the example body.
        name: of the example.
        summary: where the example's id comes from.
    """
    examples: dict[str, Any] = {name: {"summary": summary, "value": example}}
    return Path(pattern=SLUG_PATTERN, description=description, openapi_examples=examples)


DevicePath = Annotated[str, id_in_path("The device's id.", "sim", "sim", "the simulated device")]
CalibrationPath = Annotated[
    str, id_in_path("The calibration's id.", "sim-nominal", "nominal", "the simulator's own")
]
DeviceFilter = Annotated[
    str | None,
    Query(pattern=SLUG_PATTERN, description="Only those of this device.", examples=["sim"]),
]
ExpectedActive = Annotated[
    str | None,
    Query(
        pattern=SLUG_PATTERN,
        description="The calibration that you believe to be active now; where another one is, "
        "nothing is changed (409).",
    ),
]
Limit = Annotated[int, Query(ge=1, le=200, description="Most items to return.")]
Offset = Annotated[int, Query(ge=0, le=2**31 - 1, description="Items to skip.")]


Row = TypeVar("Row")
Item = TypeVar("Item")


@dataclass(frozen=True)
class Paging:
    """Which part of a list is asked for."""

    limit: Limit = 50
    offset: Offset = 0


PagingDep = Annotated[Paging, Depends()]


def page_of(
    session: Session, listed: Select[Row], paging: Paging, document: Callable[[Row], Item]
) -> Page[Item]:
    """Return a page.

    Args:
        session: the session.
        listed: the whole list of rows, in its order.
        paging: the part.
        document: returns a row as clients see it.
    """
    counted: Select[Any] = listed.with_only_columns(
        func.count(), maintain_column_froms=True
    ).order_by(None)
    rows = session.scalars(listed.limit(paging.limit).offset(paging.offset)).all()
    return Page(
        items=[document(row) for row in rows],
        total=session.scalar(counted) or 0,
        limit=paging.limit,
        offset=paging.offset,
    )


class JsonTypes:
    """Marks a body parameter as validated from its JSON text, in pydantic's strict JSON mode.

    FastAPI parses JSON first and validates Python values, where strict validation refuses lists
    for tuples and objects for dataclasses, and lax validation takes ``"3"`` for 3.
    """

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Put the validation of the text in front; the JSON schema stays that of the type."""
        adapter: TypeAdapter[Any] = TypeAdapter(source)

        def validate(text: Any, _inner: ValidatorFunctionWrapHandler) -> Any:
            try:
                return adapter.validate_json(text, strict=True)
            except ValidationError as error:
                if not any(_is_whole_number(item) for item in error.errors()):
                    raise
            return adapter.validate_json(_with_whole_numbers(text), strict=True)

        return core_schema.no_info_wrap_validator_function(validate, handler(source))


def _is_whole_number(error: ErrorDetails) -> bool:
    """Whether a strict validation refused 8.0 as an integer, which JSON schema says it is."""
    found = error["input"]
    return error["type"] == "int_type" and isinstance(found, float) and found.is_integer()


def _with_whole_numbers(text: str | bytes) -> str:
    """Write the whole numbers of a JSON text without a decimal point."""

    def number(literal: str) -> float | int:
        value = float(literal)
        return int(value) if value.is_integer() else value

    return json.dumps(json.loads(text, parse_float=number))


_LARGE_BYTES: Final = 64 * 1024
_MAX_MEMBERS: Final = 1000
"""Of one object: each that a model does not know is an error of its own."""


class _JsonRequest(Request):
    async def json(self) -> Any:
        """Return the body's text, for ``FromJson`` to validate."""
        return await self.body()


class JsonRoute(APIRoute):
    """A route whose body, where it takes one, is ``application/json`` read by ``FromJson``."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return FastAPI's handler behind the check of the body."""
        handle = super().get_route_handler()
        if self.body_field is None:
            return handle

        async def strict(request: Request) -> Response:
            request = _JsonRequest(request.scope, request.receive)
            # Here and not in json(), from where FastAPI lets no exception of ours out.
            body = await request.body()
            check = partial(check_json_body, request.headers.get("content-type"), body)
            if len(body) > _LARGE_BYTES:  # the server goes on with others meanwhile
                await run_sync(check)
            else:
                check()
            return await handle(request)

        return strict


def check_json_body(content_type: str | None, body: bytes) -> None:
    """Check that a body is JSON, says so, and gives no key of an object twice.

    Raises:
        UnsupportedMediaType, MalformedJson, DuplicateKey.
        BodyTooLarge: an object has too many members.
    """
    if not _is_json(content_type) and (content_type or body):
        given = f'"{content_type}"' if content_type else "not given"
        raise UnsupportedMediaType(f"the body's media type is {given}; send application/json")
    if not body:
        return
    try:
        json.loads(body, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        found = json.dumps(error.doc[error.pos : error.pos + 20])
        raise MalformedJson(
            f"the body is not JSON: {error.msg} at line {error.lineno} column {error.colno}, "
            f"where it has {found}; send a JSON document"
        ) from error
    except UnicodeDecodeError as error:
        raise MalformedJson(f"the body is not UTF-8: {error.reason}; send UTF-8") from error
    except RecursionError as error:
        raise MalformedJson("the body is nested too deeply to be read") from error
    except ValueError as error:  # an integer of thousands of digits
        raise MalformedJson(f"the body cannot be read: {error}") from error


def _unique(pairs: list[tuple[str, Any]]) -> None:
    if len(pairs) > _MAX_MEMBERS:
        raise BodyTooLarge(
            f"an object of the body has {len(pairs)} members; the limit is {_MAX_MEMBERS}"
        )
    seen: set[str] = set()
    for key, _ in pairs:
        if key in seen:
            raise DuplicateKey(
                f"the key {json.dumps(key)} is given twice in one object; give it once", key=key
            )
        seen.add(key)


def _is_json(content_type: str | None) -> bool:
    message = email.message.Message()
    message["content-type"] = content_type or ""
    if message.get_content_maintype() != "application" or not content_type:
        return False
    subtype = message.get_content_subtype()
    return subtype == "json" or subtype.endswith("+json")
