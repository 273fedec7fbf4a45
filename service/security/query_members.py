"""Members of a query that no operation knows are refused, for all routes in one place."""

from collections.abc import Sequence
from urllib.parse import parse_qsl

from fastapi.dependencies.utils import get_flat_params
from fastapi.params import Query
from fastapi.routing import RouteContext

from service.problems.errors import UnknownQueryMember
from service.problems.handlers import unknown_websocket

_SHOWN_CHARACTERS = 100


def query_members(route: RouteContext) -> tuple[str, ...] | None:
    """Return the names that a route's query may have; None: any, as nothing reads it.

    A websocket of an unknown path is told that, whatever its query.
    """
    if route.endpoint is unknown_websocket:
        return None
    dependant = getattr(route, "dependant", None)
    if dependant is None:
        return ()
    fields = get_flat_params(dependant)
    return tuple(field.alias for field in fields if isinstance(field.field_info, Query))


def check_members(query: bytes, known: Sequence[str] | None) -> None:
    """Check that a query has known members only.

    Raises:
        UnknownQueryMember: it has another; which, and the known ones.
    """
    if known is None or not query:
        return
    for name, _ in parse_qsl(query.decode("latin-1"), keep_blank_values=True):
        if name not in known:
            shown = name if len(name) <= _SHOWN_CHARACTERS else f"{name[:_SHOWN_CHARACTERS]}..."
            listed = f"known are {', '.join(known)}" if known else "this address takes none"
            raise UnknownQueryMember(
                f'the query has "{shown}", which is not known here; {listed}',
                member=shown,
                known=list(known),
            )
