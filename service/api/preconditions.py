"""Entity tags of resources and conditional requests: ETag, If-Match, If-None-Match (RFC 9110).

A tag is the hash of the resource as clients read it, so that it changes with whatever they see and
with nothing else: If-None-Match goes by all of it. Where a resource has members that other
operations change, as a device its active calibration, its class names them, and the tag begins with
the hash of the others: If-Match goes by that part alone, since a PATCH undoes nothing of the rest.
What a request depends on is compared in the transaction that makes the change, with the row locked.
"""

import hashlib
import json
import re
from dataclasses import dataclass
from typing import Annotated, Any, Final

from fastapi import Depends, Header
from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import Response

from service.api.paging import Page
from service.problems.errors import InvalidPrecondition, PreconditionFailed, PreconditionRequired

_ANY: Final = "*"
_TAG: Final = r'(?:W/)?"[\x21\x23-\x7e\x80-\xff]*"'
_LIST: Final = re.compile(rf"\s*{_TAG}(?:\s*,\s*{_TAG})*\s*")
_SHOWN_CHARACTERS: Final = 100

ETAG_HEADER: Final[dict[str, Any]] = {
    "ETag": {
        "description": "Changes whenever the resource does; send it back in `If-Match` to change "
        "just what you read, or in `If-None-Match` to be answered 304 while nothing has changed.",
        "schema": {"type": "string"},
    }
}
IF_MATCH_SCHEMA: Final[dict[str, Any]] = {
    "type": "string",
    "pattern": r'^(\*|(W/)?"[!#-~]*"(, *(W/)?"[!#-~]*")*)$',
}
NOT_MODIFIED: Final[dict[str, Any]] = {
    "description": "The resource is what `If-None-Match` names.",
    "headers": ETAG_HEADER,
}
IF_NONE_MATCH: Final[dict[str, Any]] = {
    "name": "If-None-Match",
    "in": "header",
    "required": False,
    "description": "The ETag that you have; while it is the current one, the answer is 304.",
    "schema": {"type": "string"},
}


def etag_of(document: BaseModel) -> str:
    """Return the strong entity tag of a resource as clients read it."""
    return _tag_of_body(document.model_dump_json(by_alias=True).encode(), members_apart(document))


def members_apart(model: object) -> frozenset[str]:
    """Return the members of a resource, or of its class, that PATCH and PUT do not change."""
    apart: frozenset[str] = getattr(model, "MEMBERS_APART", frozenset())
    return apart


def _tag_of_body(body: bytes, apart: frozenset[str]) -> str:
    whole = _hash(body)
    if not apart:
        return f'"{whole}"'
    document = json.loads(body)
    kept = {name: value for name, value in document.items() if name not in apart}
    return f'"{_hash(json.dumps(kept, sort_keys=True).encode())}.{whole}"'


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


def _changeable(tag: str) -> str:
    """Return the part of a tag that If-Match goes by."""
    return tag.strip('"').partition(".")[0]


def _tags(text: str) -> frozenset[str]:
    return frozenset(re.findall(_TAG, text))


@dataclass(frozen=True)
class Precondition:
    """Precondition of a change (optimistic concurrency).

    Args:
        tags: one of them is the resource's; None: it need only exist.
        whole: the whole resource is as it was read, as for its deletion; else what PATCH changes.
    """

    tags: frozenset[str] | None = None
    whole: bool = False

    def check(self, current: BaseModel) -> None:
        """Compare with the resource as it is now, in the transaction that changes it.

        Raises:
            PreconditionFailed: it is not what the client read.
        """
        if self.tags is None:
            return
        tag = etag_of(current)
        same = tag in self.tags
        if not self.whole:
            same = _changeable(tag) in map(_changeable, self.tags)
        if not same:
            given = ", ".join(sorted(self.tags))[:_SHOWN_CHARACTERS]
            raise PreconditionFailed(
                f"the resource was changed after you read it: its ETag is {tag}, If-Match has "
                f"{given}; read it again and apply your change to what it is now",
                etag=tag,
                if_match=given,
            )


_IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        description="The ETag of the resource as you read it; where it has changed since, nothing "
        "is done (412). `*`: change it whatever it is now.",
        openapi_examples={
            "any": {"summary": "whatever it is now", "value": _ANY},
        },
    ),
]


def _optional(if_match: _IfMatch = None) -> Precondition:
    return _precondition(if_match, whole=True)


def _precondition(if_match: str | None, *, whole: bool) -> Precondition:
    if if_match is None or if_match.strip() == _ANY:
        return Precondition()
    if _LIST.fullmatch(if_match) is None:
        raise InvalidPrecondition(
            f"If-Match is {if_match[:_SHOWN_CHARACTERS]}; send the ETag of the resource with its "
            'quotes, such as "5f0c", or *',
            if_match=if_match[:_SHOWN_CHARACTERS],
        )
    return Precondition(_tags(if_match), whole)


def _required(request: Request, if_match: _IfMatch = None) -> Precondition:
    if if_match is None:
        raise PreconditionRequired(
            f"{request.method} {request.url.path} needs the header If-Match: the ETag that GET of "
            "it answers, so that nobody's change is undone unseen, or * to change it whatever it "
            "is now"
        )
    return _precondition(if_match, whole=False)


RequiredIfMatch = Annotated[Precondition, Depends(_required)]
OptionalIfMatch = Annotated[Precondition, Depends(_optional)]


def has_etag(method: str, path: str, answer: object) -> bool:
    """Whether an operation answers a single resource, which has an entity tag."""
    return (
        method in ("GET", "PATCH", "PUT")
        and "{" in path
        and isinstance(answer, type)
        and issubclass(answer, BaseModel)
        and not issubclass(answer, Page)
    )


def tagged(request: Request, response: Response, apart: frozenset[str]) -> Response:
    """Return the answer with its entity tag, or 304 where the client has it already.

    What no cache may keep has no tag: it is another thing with each request.
    """
    if response.status_code != 200 or response.headers.get("Cache-Control") == "no-store":
        return response
    tag = _tag_of_body(bytes(response.body), apart)
    response.headers["ETag"] = tag
    wanted = request.headers.get("If-None-Match")
    if wanted is None or request.method != "GET":
        return response
    if wanted.strip() == _ANY or tag in {one.removeprefix("W/") for one in _tags(wanted)}:
        return Response(status_code=304, headers={"ETag": tag})
    return response
