"""Pagination of database queries: total count, limit and offset."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from fastapi import Depends
from sqlalchemy import Select, func
from sqlalchemy.orm import Session

from service.api.base_models import Page
from service.api.request_parameters import Limit, Offset

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
