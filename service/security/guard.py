"""Guard: ASGI middleware that authenticates a request and checks its operation's scope.

It stands before the router, so that nothing of a request is read for who may not ask, and refuses
members of a query that the operation does not know. It finds the route as the router does;
`confirm`, a dependency of every route, checks that both found the same one.
"""

import json
from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from anyio.to_thread import run_sync
from fastapi.routing import RouteContext, iter_route_contexts
from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.routing import BaseRoute, Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from compute.errors import LumilineError
from service.logs import request_record
from service.principal import LOCAL, Act, Principal, current_act
from service.problems.errors import MissingScope, TooManyAttempts, Unauthenticated
from service.problems.handlers import error_response, refuse
from service.security.audit_entry import record_act, record_repeats
from service.security.credential import check_query, credential_of, why_not_local
from service.security.operation_scopes import OPERATION_SCOPES, PUBLIC, RECORDED_SCOPES
from service.security.query_members import check_members, query_members
from service.security.refusal_aggregation import RefusalAggregator
from service.settings import Settings

if TYPE_CHECKING:
    from service.security.authenticator import Authenticator

ACT: Final = "lumiline.act"
"""Under which the ASGI scope has the act of a request that was let in."""
_OPERATION: Final = "lumiline.operation"
_SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
_Matches = Callable[[Scope], tuple[Match, Scope]]
_REALM: Final = 'Bearer realm="lumiline"'


class _Route(NamedTuple):
    """A route: its operation, its path's template, and the names that its query may have."""

    operation: str
    path: str
    matches: _Matches
    query: tuple[str, ...] | None


def operation_of(route: RouteContext | BaseRoute) -> str:
    """Return the name under which the table has a route."""
    return str(getattr(route, "operation_id", None) or getattr(route, "name", "?"))


def check_complete(routes: Iterable[BaseRoute]) -> tuple[RouteContext, ...]:
    """Return all routes in the order in which they are tried, each of which the table has.

    Raises:
        ValueError: a route is not in the table, or the table has one that there is not.
    """
    contexts = tuple(iter_route_contexts(list(routes)))
    names = {operation_of(route) for route in contexts}
    for missing in sorted(names - OPERATION_SCOPES.keys()):
        raise ValueError(
            f'operation "{missing}" is not in service/security/operation_scopes.py; give it a '
            'scope, or "public"'
        )
    for name in sorted(OPERATION_SCOPES.keys() - names):
        raise ValueError(
            f'service/security/operation_scopes.py has "{name}", which no route has; remove it'
        )
    return contexts


async def confirm(connection: HTTPConnection) -> None:
    """Refuse to run a route that the guard did not let in: a dependency of every route."""
    operation = operation_of(connection.scope["route"])
    if connection.scope.get(_OPERATION) != operation:
        raise RuntimeError(f'the guard did not let operation "{operation}" in')


class Guard:
    """Answers 401 or 403 where the operation's scope is not granted."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._settings = settings
        self._routes: tuple[_Route, ...] | None = None
        self._refusals: RefusalAggregator | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, self._until_closing(receive), send)
            return
        headers = Headers(scope=scope)
        record = request_record(scope)
        route = self._route(scope)
        if route is None:  # no such path, or not by this method: the router says so
            await self._app(scope, receive, send)
            return
        operation, record.route = route.operation, route.path
        scope[_OPERATION] = operation
        address = (scope.get("client") or ("unknown",))[0]
        act = Act(LOCAL, operation, record.id, address)
        try:
            check_query(scope["query_string"])
            if OPERATION_SCOPES[operation] == PUBLIC:
                check_members(scope["query_string"], route.query)
                await self._app(scope, receive, send)
                return
            act.principal = await self._principal(scope, headers, address)
            await self._check_scope(scope, act)
            check_members(scope["query_string"], route.query)
        except LumilineError as error:
            await _refuse(error, scope, receive, send)
            return
        scope[ACT] = act
        token = current_act.set(act)
        try:
            if _is_recorded(scope, operation):
                send = _Recorded(scope, act, send)
            await self._app(scope, receive, send)
        finally:
            current_act.reset(token)

    def _route(self, scope: Scope) -> _Route | None:
        """Return the route of a request; None where the router finds none."""
        if self._routes is None:
            routes = check_complete(scope["app"].routes)
            self._routes = tuple(
                _Route(operation_of(one), str(one.path), one.matches, query_members(one))
                for one in routes
            )
        for route in self._routes:
            if route.matches(scope)[0] == Match.FULL:
                return route
        return None

    async def _principal(self, scope: Scope, headers: Headers, address: str) -> Principal:
        credential = credential_of(headers, websocket=scope["type"] == "websocket")
        if credential is None:
            reason = why_not_local(self._settings, address, headers)
            if reason is not None:
                raise Unauthenticated(
                    f"{reason}; send a key in the header Authorization: Bearer "
                    "(docs/how-to/security.md says how to make one)"
                )
            return LOCAL
        authenticator: Authenticator = scope["app"].state.authenticator
        return await run_sync(authenticator.principal, credential, address)

    async def _check_scope(self, scope: Scope, act: Act) -> None:
        needed = OPERATION_SCOPES[act.operation]
        if needed in act.principal.scopes:
            return
        has = ", ".join(sorted(act.principal.scopes)) or "none"
        error = MissingScope(
            f"{act.operation} needs the scope {needed}; {act.principal.label} has {has}",
            scope=needed,
        )
        if _is_recorded(scope, act.operation) and self._refusals_of(scope).is_first(act):
            await record_act(scope, act, "refused", error.detail)
        raise error

    def _refusals_of(self, scope: Scope) -> RefusalAggregator:
        if self._refusals is None:
            self._refusals = RefusalAggregator(partial(record_repeats, scope["app"].state.database))
        return self._refusals

    def _until_closing(self, receive: Receive) -> Receive:
        """Record the counted refusals before the database is closed."""

        async def received() -> Message:
            message = await receive()
            if message["type"] == "lifespan.shutdown" and self._refusals is not None:
                await self._refusals.close()
                self._refusals = None
            return message

        return received


def _is_recorded(scope: Scope, operation: str) -> bool:
    changes = scope["type"] == "http" and scope["method"] not in _SAFE
    return changes and OPERATION_SCOPES[operation] in RECORDED_SCOPES


class _Recorded:
    """Sends an answer once the audit log has its entry.

    Changes are there already, from their own transactions; conflicts, and what changes nothing in
    the database (starting a device), come here.
    """

    def __init__(self, scope: Scope, act: Act, send: Send) -> None:
        self._scope = scope
        self._act = act
        self._send = send
        self._start: Message | None = None

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            status = message["status"]
            if status < 300 and not self._act.recorded:
                await record_act(self._scope, self._act, "done", None)
            elif status in (409, 412):
                self._start = message  # until it is known why
                return
        elif self._start is not None and message["type"] == "http.response.body":
            start, self._start = self._start, None
            await record_act(self._scope, self._act, "refused", _detail(message["body"]))
            await self._send(start)
        await self._send(message)


def _detail(body: bytes) -> str | None:
    try:
        return str(json.loads(body)["detail"])[:1000]
    except (ValueError, KeyError, TypeError):
        return None


async def _refuse(error: LumilineError, scope: Scope, receive: Receive, send: Send) -> None:
    response = error_response(error, scope["path"], _headers(error))
    await refuse(response, scope, receive, send)


def _headers(error: LumilineError) -> dict[str, str]:
    if isinstance(error, Unauthenticated):
        return {"WWW-Authenticate": _REALM}
    if isinstance(error, MissingScope):
        scope = error.context["scope"]
        return {"WWW-Authenticate": f'{_REALM}, error="insufficient_scope", scope="{scope}"'}
    if isinstance(error, TooManyAttempts):
        return {"Retry-After": str(error.context["retry_after_s"])}
    return {}
