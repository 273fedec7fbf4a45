"""`lumiline openapi`: prints the OpenAPI document of this version."""

import json

import typer

from service.app import create_app
from service.settings import Settings


def run() -> None:
    """Print the document; nothing is opened or started."""
    typer.echo(json.dumps(create_app(Settings()).openapi(), indent=2, ensure_ascii=False))
