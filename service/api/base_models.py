"""Base classes and field types of REST schemas: strict models, ids, texts, times."""

import json
import re
from datetime import datetime
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    WithJsonSchema,
)

from compute.errors import InvalidParameter

SLUG_PATTERN = r"^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$"

Slug = Annotated[str, StringConstraints(pattern=SLUG_PATTERN)]
"""An id: lower case letters, digits and hyphens, at most 63 characters."""


def checked_slug(text: str) -> str:
    """Return an id that came another way than through a model or a path.

    Raises:
        InvalidParameter: it does not have the form of an id.
    """
    # fullmatch: "$" alone would let a line's end through.
    if re.fullmatch(SLUG_PATTERN, text) is None:
        cut = text if len(text) <= 100 else text[:97] + "..."
        raise InvalidParameter(
            f"{json.dumps(cut)} is not an id; an id has 1 to 63 lower case letters, digits and "
            "hyphens, with no hyphen at either end",
            id=cut,
        )
    return text


# A NUL cannot be stored in PostgreSQL's text.
Text200 = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\u0000]*$")]
Note = Annotated[str, StringConstraints(max_length=2000, pattern=r"^[^\u0000]*$")]
Name = Annotated[str, StringConstraints(min_length=1, max_length=64, pattern=r"^[^\u0000]*$")]

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, description="[mm]")]
Position = tuple[Coordinate, Coordinate, Coordinate]


class RequestModel(BaseModel):
    """Base of what clients send: no unknown field, no NaN, immutable; see also FromJson.

    Its lists are annotated with ``FIRST_ERROR_ONLY``, and so are those of the models in it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ResponseModel(BaseModel):
    """Base of what clients receive."""

    model_config = ConfigDict(frozen=True)


Model = TypeVar("Model", bound=BaseModel)


def from_attributes(model: type[Model], source: object, /, **members: Any) -> Model:
    """Return a model with the values that an object, such as a row of the database, has.

    Args:
        model: the model.
        source: the object.
        members: fields that it has not, or not as the model has them.
    """
    for name in model.model_fields.keys() - members.keys():
        if hasattr(source, name):
            members[name] = getattr(source, name)
    return model.model_validate(members)


def absent() -> Any:
    """Return the default of a field that may be left out but not be null (PATCH).

    A default factory keeps the default out of the JSON schema, where null would look allowed.
    """
    return Field(default_factory=lambda: None)


Moment = Annotated[datetime, Field(description="UTC, RFC 3339.")]

_YEARS = range(1970, 9999)


def _in_years(given: datetime) -> datetime:
    """Refuse moments whose year has no neighbour: in another time zone they are none."""
    if given.year not in _YEARS:
        raise ValueError(f"its year must be {_YEARS[0]} to {_YEARS[-1]}")
    return given


RequestMoment = Annotated[
    AwareDatetime,
    AfterValidator(_in_years),
    # For who makes requests from the schema: the years, as a pattern.
    WithJsonSchema(
        {
            "type": "string",
            "format": "date-time",
            "pattern": "^(19[7-9]\\d|[2-8]\\d{3}|9([0-8]\\d|9[0-8])\\d|999[0-8])-",
            "description": "RFC 3339 with its time zone, of the years 1970 to 9998.",
        }
    ),
]
"""A moment that a client sends."""
