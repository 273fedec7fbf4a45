"""The OpenAPI document of the service, made once for all tests of a process: it takes seconds."""

from functools import cache
from typing import Any

from service.application.app import create_app
from service.settings import Settings


@cache
def openapi_document() -> dict[str, Any]:
    """Return the document, which nobody may change."""
    return create_app(Settings()).openapi()
