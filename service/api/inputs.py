"""Inputs of endpoints: parts of the application, JSON bodies, ids and filters."""

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from types import MethodType
from typing import Annotated, Any, cast

from fastapi import Depends, Path, Query, Request
from fastapi.routing import APIRoute
from pydantic import GetCoreSchemaHandler, TypeAdapter, ValidatorFunctionWrapHandler
from pydantic_core import CoreSchema, core_schema
from starlette.responses import Response

from service.api.base_models import SLUG_PATTERN
from service.api.idempotency import once, takes_key
from service.api.json_body import INLINE_BYTES, BodyReader, check_json_body, validate_text
from service.api.preconditions import members_apart, tagged
from service.database.engine import Database
from service.database.gateway import DEVICES, Gateway
from service.jobs.run_manager import RunManager
from service.pipeline.interface import Pipeline, RemoteStations
from service.problems.errors import DeviceElsewhere, NotReady
from service.settings import Settings


def of_application(name: str) -> Any:
    """Return the dependency on a part of the application, by its name in ``app.state``."""

    def part(request: Request) -> Any:
        return getattr(request.app.state, name)

    return Depends(part)


def _live(request: Request) -> Pipeline:
    live: Pipeline | None = request.app.state.live
    if live is None:
        raise NotReady("the live pipeline does not run; restart the server", part="live")
    gateway: Gateway = request.app.state.gateway
    if not gateway.holds(DEVICES):
        return cast("Pipeline", _Elsewhere(gateway, live, request.app.state.stations))
    return live


class _Elsewhere:
    """Refuses what is asked of devices that another gateway has; all have those of stations.

    Args:
        gateway: this one.
        live: its pipeline.
        stations: those on other machines; None: all devices are elsewhere.
    """

    def __init__(self, gateway: Gateway, live: Pipeline, stations: RemoteStations | None) -> None:
        self._gateway = gateway
        self._live = live
        self._stations = stations

    def __getattr__(self, name: str) -> Any:
        stations = self._stations
        if stations is None:
            raise elsewhere(self._gateway)
        member = getattr(self._live, name)
        if not isinstance(member, MethodType):
            return member  # the newest poses, states of holds, ...

        def of_device(*args: Any, **members: Any) -> Any:
            device_id = args[0] if args else members.get("device_id")
            if isinstance(device_id, str) and not stations.is_far(device_id):
                raise elsewhere(self._gateway, device_id)
            return member(*args, **members)

        return of_device


def elsewhere(gateway: Gateway, device_id: str | None = None) -> DeviceElsewhere:
    """Return the error where another gateway than this one has the devices."""
    holder = gateway.holder(DEVICES)
    if holder is None:
        where = "no gateway has the devices now; one takes them within seconds, so ask again"
    else:
        where = f'gateway "{holder}" has the devices, and this is "{gateway.name}": ask that one'
    context = {} if device_id is None else {"device_id": device_id}
    return DeviceElsewhere(where, **context, gateway=holder)


DatabaseDep = Annotated[Database, of_application("database")]
LiveDep = Annotated[Pipeline, Depends(_live)]
GatewayDep = Annotated[Gateway, of_application("gateway")]
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
            return text.value if isinstance(text, _Read) else validate_text(adapter, text)

        return core_schema.no_info_wrap_validator_function(validate, handler(source))


@dataclass(frozen=True)
class _Read:
    """A body that was validated already."""

    value: Any


class _JsonRequest(Request):
    read: _Read | None = None

    async def json(self) -> Any:
        """Return what ``JsonTypes`` validates: the body's text, or what became of it."""
        return await self.body() if self.read is None else self.read


_Handler = Callable[[Request], Coroutine[Any, Any, Response]]


def _tagging(handle: _Handler, apart: frozenset[str]) -> _Handler:
    async def answer(request: Request) -> Response:
        return tagged(request, await handle(request), apart)

    return answer


class JsonRoute(APIRoute):
    """A route whose body, where it takes one, is ``application/json`` read by ``JsonTypes``."""

    def get_route_handler(self) -> _Handler:
        """Return FastAPI's handler behind the check of the body."""
        handle = super().get_route_handler()
        if "headers" in self.responses.get(200, {}):
            handle = _tagging(handle, members_apart(self.response_model))
        if self.body_field is None:
            return once(handle) if takes_key(self.openapi_extra) else handle
        wanted = self.body_field.field_info.annotation

        async def strict(request: Request) -> Response:
            request = _JsonRequest(request.scope, request.receive)
            # Here and not in json(), from where FastAPI lets no exception of ours out.
            body = await request.body()
            content_type = request.headers.get("content-type")
            if len(body) > INLINE_BYTES:
                reader: BodyReader = request.app.state.bodies
                request.read = _Read(await reader.read(wanted, content_type, body))
            else:
                check_json_body(content_type, body)
            return await handle(request)

        return once(strict) if takes_key(self.openapi_extra) else strict
