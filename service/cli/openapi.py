"""`lumiline openapi`: prints the OpenAPI document of this version."""

import json

import typer

from service.application.app import create_app
from service.cli.serve import load_settings


def run() -> None:
    """Print the document; nothing is opened or started."""
    typer.echo(json.dumps(create_app(load_settings()).openapi(), indent=2, ensure_ascii=False))
