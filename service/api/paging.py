"""Lists in pages: a limit and a cursor in the query, items and the next cursor in the answer.

A cursor holds the order's values of the last item of its page, so that what is added or deleted
meanwhile neither repeats nor hides another item; clients send it back as it is.
"""

import base64
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any, Final, Generic, TypeVar

from fastapi import Depends, Query, Request
from fastapi.exceptions import RequestValidationError
from pydantic import Field
from sqlalchemy import ColumnElement, Select, and_, or_
from sqlalchemy.orm import Session

from service.api.base_models import ResponseModel
from service.database.models import UtcDateTime

Item = TypeVar("Item")
Listed = TypeVar("Listed")
Row = TypeVar("Row")
Value = str | int
"""What an item is ordered by, as a cursor has it."""

Limit = Annotated[int, Query(ge=1, le=200, description="Most items to return.")]
Cursor = Annotated[
    str | None,
    Query(
        max_length=1000,
        description="`next_cursor` of the page before, of the same list with the same filter; left "
        "out: the first page.",
    ),
]
NEWEST_FIRST: Final = ("-created_at", "id")
LATEST_FIRST: Final = ("-id",)
"""Order of histories, whose ids are numbers that grow."""
BY_ID: Final = ("id",)
"""Order of most lists: columns of the row, with a minus where the largest comes first."""
_OF_PAGES: Final = ("limit", "cursor")


class Page(ResponseModel, Generic[Item]):
    """Part of a list."""

    items: list[Item]
    next_cursor: str | None = Field(
        description="Send it as `cursor` for the next items; null: there are no more."
    )


@dataclass(frozen=True)
class Paging:
    """Requested page of a list.

    Args:
        limit: most items of it.
        after: what the last item before it is ordered by; None: it is the first part.
        of: tells the list and its filter from others.
    """

    limit: int
    after: tuple[Value, ...] | None
    of: str

    def cursor(self, values: Sequence[Value]) -> str:
        """Return the cursor behind an item that is ordered by these values."""
        text = json.dumps([self.of, *values], separators=(",", ":"))
        return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")

    def checked_after(self, kinds: Sequence[type]) -> tuple[Value, ...] | None:
        """Return what the last item before is ordered by, one value of each of these kinds.

        Raises:
            RequestValidationError: the cursor has others.
        """
        if self.after is not None and list(map(type, self.after)) != list(kinds):
            raise _refusal(self.cursor(self.after), "must be `next_cursor` of a page of this list")
        return self.after


def _paging(request: Request, limit: Limit = 50, cursor: Cursor = None) -> Paging:
    """Return what the query asks for.

    Raises:
        RequestValidationError: the cursor is none, or one of another list or filter.
    """
    query = sorted(pair for pair in request.query_params.multi_items() if pair[0] not in _OF_PAGES)
    text = json.dumps([request.url.path, query])
    of = hashlib.sha256(text.encode()).hexdigest()[:16]
    if cursor is None:
        return Paging(limit, None, of)
    try:
        padded = cursor + "=" * (-len(cursor) % 4)
        given = json.loads(base64.b64decode(padded, altchars=b"-_", validate=True))
    except (ValueError, RecursionError):
        given = None
    values = given[1:] if isinstance(given, list) else []
    if not values or not all(map(_is_storable, values)):
        raise _refusal(cursor, "must be `next_cursor` of the page before; leave it out to begin")
    if given[0] != of:
        raise _refusal(
            cursor,
            "must be of the same list with the same filter, which this one is not; leave it out to "
            "begin",
        )
    return Paging(limit, tuple(values), of)


def _is_storable(value: object) -> bool:
    """Whether databases can compare with a value: others would fail in them."""
    if type(value) is int:
        return -(2**63) <= value < 2**63
    if type(value) is not str or "\0" in value:
        return False
    return not any("\ud800" <= character <= "\udfff" for character in value)


def _refusal(cursor: str, message: str) -> RequestValidationError:
    return RequestValidationError(
        [{"type": "cursor", "loc": ("query", "cursor"), "msg": message, "input": cursor}]
    )


PagingDep = Annotated[Paging, Depends(_paging)]


def page_of(
    session: Session,
    listed: Select[Row],
    paging: Paging,
    document: Callable[[Row], Item],
    order: Sequence[str] = NEWEST_FIRST,
) -> Page[Item]:
    """Return a page of rows.

    Args:
        session: the session.
        listed: all rows that the filter matches.
        paging: the part.
        document: returns a row as clients see it.
        order: columns of the row, the last of which tells all rows apart; see NEWEST_FIRST.

    Raises:
        RequestValidationError: the cursor is of another order.
    """
    table: Any = listed.column_descriptions[0]["entity"]
    columns = [(getattr(table, name.removeprefix("-")), name.startswith("-")) for name in order]
    moments = [isinstance(column.type, UtcDateTime) for column, _ in columns]
    after = paging.checked_after(
        [
            str if moment else column.type.python_type
            for (column, _), moment in zip(columns, moments, strict=True)
        ]
    )
    if after is not None:
        values = [
            _moment(paging, str(value)) if moment else value
            for moment, value in zip(moments, after, strict=True)
        ]
        listed = listed.where(_behind(columns, values))
    ordered = listed.order_by(None).order_by(
        *(column.desc() if descending else column for column, descending in columns)
    )
    rows = session.scalars(ordered.limit(paging.limit + 1)).all()
    return _page(
        rows,
        paging,
        document,
        lambda row: [_value(getattr(row, column.key)) for column, _ in columns],
    )


def page_of_sequence(
    listed: Sequence[Listed],
    paging: Paging,
    document: Callable[[Listed], Item | None],
    key: Callable[[Listed], tuple[Value, ...]],
) -> Page[Item]:
    """Return a page of items that are not rows of the database.

    Args:
        listed: all of it.
        paging: the part.
        document: returns one as clients see it; None: it is gone meanwhile.
        key: returns what one is ordered by, which tells all apart.

    Raises:
        RequestValidationError: the cursor is of another order.
    """
    ordered = sorted(listed, key=key)
    if ordered:
        after = paging.checked_after([type(value) for value in key(ordered[0])])
        ordered = [one for one in ordered if after is None or key(one) > after]
    return _page(ordered[: paging.limit + 1], paging, document, key)


def _page(
    found: Sequence[Listed],
    paging: Paging,
    document: Callable[[Listed], Item | None],
    key: Callable[[Listed], Sequence[Value]],
) -> Page[Item]:
    """Return the page of at most ``limit`` of what was found, of which one more says that there
    are more.
    """
    shown = found[: paging.limit]
    more = len(found) > len(shown)
    return Page(
        items=[item for one in shown if (item := document(one)) is not None],
        next_cursor=paging.cursor(key(shown[-1])) if more else None,
    )


def _behind(columns: Sequence[tuple[Any, bool]], values: Sequence[Any]) -> ColumnElement[bool]:
    """Return the condition that a row comes behind the one with these values."""
    either = []
    for index, (column, descending) in enumerate(columns):
        same = [
            before == value for (before, _), value in zip(columns[:index], values, strict=False)
        ]
        beyond = column < values[index] if descending else column > values[index]
        either.append(and_(*same, beyond))
    return or_(*either)


def _value(value: Any) -> Value:
    found: Value = value.isoformat() if isinstance(value, datetime) else value
    return found


def _moment(paging: Paging, text: str) -> datetime:
    refusal = _refusal(paging.cursor(paging.after or ()), "must be `next_cursor` of a page")
    try:
        moment = datetime.fromisoformat(text)
        if moment.tzinfo is None:
            raise refusal
        return moment.astimezone(UTC)
    except (ValueError, OverflowError):  # the year 0 or 10000 elsewhere
        raise refusal from None
