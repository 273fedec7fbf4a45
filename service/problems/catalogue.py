"""Catalogue of problem types: code, HTTP status, title and meaning (RFC 9457)."""

import inspect
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, Field

import service.problems.errors as own
from compute import errors as domain
from compute.errors import LumilineError
from hardware import errors as drivers

MEDIA_TYPE: Final = "application/problem+json"

_STATUS: Final[dict[type[LumilineError], int]] = {
    domain.UnknownFrame: 404,
    drivers.DeviceNotConnected: 409,
    drivers.DeviceChanged: 409,
    drivers.MissingLibrary: 501,  # until somebody installs it: trying again does not help
}
"""Statuses of the errors of other packages that are not 422."""

_PROTOCOL: Final[tuple[tuple[str, int, str], ...]] = (
    ("bad-request", 400, "The request cannot be read as HTTP or does not fit this server."),
    ("not-found", 404, "No resource has this path."),
    ("method-not-allowed", 405, "The resource exists; the header Allow lists its methods."),
    ("invalid-request", 422, "The request does not fit the schema; `errors` lists every place."),
    ("internal-error", 500, "The server failed; its log has the cause under the same reference."),
)


class ProblemType(BaseModel):
    """A problem type: its code, status and meaning."""

    model_config = ConfigDict(frozen=True)

    code: str = Field(description="Stable name, the last part of the type's URI reference.")
    type: str = Field(description="The `type` of problem documents.")
    status: int = Field(description="The HTTP status that goes with it.")
    title: str
    meaning: str


class FieldError(BaseModel):
    """One place in a request that does not fit."""

    location: list[str | int] = Field(description="Path to the value, from `body`, `query`, ...")
    message: str
    input: str = Field(description="The value found there as JSON text, cut at 200 characters.")


class Problem(BaseModel):
    """A problem document (RFC 9457)."""

    type: str = Field(description="URI reference of the problem type; GET it for its meaning.")
    title: str
    status: int
    detail: str = Field(description="What was wrong, with the value, and what would be right.")
    instance: str = Field(description="The path that was requested.")
    errors: list[FieldError] | None = None
    context: dict[str, Any] | None = Field(default=None, description="The values by name.")


ERRORS: Final[dict[str, type[LumilineError]]] = {
    problem_type.code: problem_type
    for module in (domain, drivers, own)
    for problem_type in vars(module).values()
    if isinstance(problem_type, type) and issubclass(problem_type, LumilineError)
    if problem_type not in (LumilineError, own.ServiceError)
}
"""The errors that clients are told of, by their codes."""


def problem_type_of(error: type[LumilineError]) -> ProblemType:
    """Return the problem type of an error class; its docstring is the meaning."""
    meaning = " ".join((inspect.getdoc(error) or error.code).split())
    status = error.status if issubclass(error, own.ServiceError) else _STATUS.get(error, 422)
    return _problem_type(error.code, status, meaning)


def _problem_type(code: str, status: int, meaning: str) -> ProblemType:
    title = code.replace("-", " ").capitalize().replace("json", "JSON")
    return ProblemType(
        code=code, type=f"/problems/{code}", status=status, title=title, meaning=meaning
    )


PROBLEM_TYPES: Final[dict[str, ProblemType]] = {
    problem_type.code: problem_type
    for problem_type in sorted(
        [*(_problem_type(*row) for row in _PROTOCOL), *map(problem_type_of, ERRORS.values())],
        key=lambda problem_type: (problem_type.status, problem_type.code),
    )
}
