"""Call: a request as a value, and how its answer is read; the same for both clients."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from lumiline.client.errors import UnreadableMessage

T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)

API: Final = "/api/v1"
PAGE: Final = 200
"""Items that a page of a list has at most."""


@dataclass(frozen=True)
class ApiRequest(Generic[T]):
    """One request, and the type of its answer.

    Args:
        method: of HTTP.
        path: from the server's root.
        kind: the model that the answer is read as.
        query: parameters; those that are None are left out.
        body: sent as JSON; None: nothing.
        inside: member of the answer that is wanted; None: all of it.
    """

    method: str
    path: str
    kind: type[Any]
    query: Mapping[str, Any] = field(default_factory=dict)
    body: Mapping[str, Any] | None = None
    inside: str | None = None

    @property
    def parameters(self) -> dict[str, Any]:
        """The query without what is not given."""
        return {name: value for name, value in self.query.items() if value is not None}

    def page(self, offset: int) -> dict[str, Any]:
        """Return the query for a page of a list, from an item on."""
        return {**self.parameters, "limit": PAGE, "offset": offset}

    def read(self, answer: Any) -> T:
        """Return what the server answered, typed.

        Raises:
            UnreadableMessage: it is something else.
        """
        if self.inside is not None:
            if not isinstance(answer, dict) or self.inside not in answer:
                raise UnreadableMessage(f'{self.path} answered without "{self.inside}"')
            answer = answer[self.inside]
        found: T = _read(self.kind, answer)
        return found

    def items(self, page: Any) -> tuple[list[T], int]:
        """Return the items of a page of a list, and how many there are on all pages.

        Raises:
            UnreadableMessage: it is no page of a list.
        """
        if (
            not isinstance(page, dict)
            or not isinstance(page.get("items"), list)
            or not isinstance(page.get("total"), int)
        ):
            raise UnreadableMessage(f"{self.path} did not answer a list")
        return [_read(self.kind, one) for one in page["items"]], page["total"]


def get(
    kind: type[Model], *path: str, inside: str | None = None, **query: Any
) -> ApiRequest[Model]:
    """Return a GET of a path below the interface's root."""
    return ApiRequest("GET", path_of(*path), kind, query, inside=inside)


def post(
    kind: type[Model], *path: str, body: Mapping[str, Any] | None = None, **query: Any
) -> ApiRequest[Model]:
    """Return a POST to a path below the interface's root."""
    return ApiRequest("POST", path_of(*path), kind, query, body)


def path_of(*parts: str) -> str:
    """Return a path below the interface's root."""
    # Names of recordings have slashes, which are part of their path.
    return "/".join([API, *(quote(part) for part in parts)])


def _read(kind: type[Any], answer: Any) -> Any:
    try:
        return kind.model_validate(answer)
    except ValidationError as error:
        raise UnreadableMessage(
            f"the server's answer is no {kind.__name__}: {error.errors()[0]['msg']} at "
            f"{error.errors()[0]['loc']}"
        ) from error
