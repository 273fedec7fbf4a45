"""Reference page of the REST interface, from the OpenAPI document of the application."""

import json
from collections.abc import Iterator
from typing import Any

from generators.text import code, table
from generators.text import page as whole_page
from service.application.app import create_app
from service.settings import Settings

METHODS = ("get", "post", "put", "patch", "delete")
Document = dict[str, Any]


def page() -> str:
    """Return the page."""
    document = create_app(Settings.model_construct()).openapi()
    lines = [
        "The interface is under `/api/v1`; `lumiline openapi` prints this document, and a running",
        "server shows it at `/docs`. Guides with whole requests are in [REST guide](../api.md).",
        "",
    ]
    for tag in document["tags"]:
        lines += [f"## {tag['name']}", "", tag.get("description", ""), ""]
        for method, path, operation in _operations(document):
            if operation["tags"][0] == tag["name"]:
                lines += _operation(method, path, operation)
    lines += ["## Schemas", ""]
    for name, schema in sorted(document["components"]["schemas"].items()):
        lines += _schema(name, schema)
    return whole_page("REST interface", "`lumiline openapi`", lines)


def _operations(document: Document) -> Iterator[tuple[str, str, Document]]:
    for path, item in document["paths"].items():
        for method in METHODS:
            if method in item:
                yield method, path, item[method]


def _operation(method: str, path: str, operation: Document) -> list[str]:
    lines = [
        f"({operation['operationId']})=",
        f"### {operation.get('summary', operation['operationId'])}",
        "",
        f"**{method.upper()}** `{path}` (`{operation['operationId']}`)",
        "",
        operation.get("description", ""),
        "",
    ]
    lines += table(
        ("parameter", "in", "type", "meaning"),
        [
            (
                code(p["name"]) + (" (required)" if p.get("required") else ""),
                p["in"],
                _type(p.get("schema", {})),
                p.get("description", p.get("schema", {}).get("description", "")),
            )
            for p in operation.get("parameters", ())
        ],
    )
    for media, content in operation.get("requestBody", {}).get("content", {}).items():
        lines += [f"Body (`{media}`): {_type(content.get('schema', {})) or 'bytes'}", ""]
        for example in list(content.get("examples", {}).values())[:1]:
            if "value" in example and len(json.dumps(example["value"])) < 1500:
                value = json.dumps(example["value"], indent=2)
                lines += [f"{example.get('summary', 'Example')}:", ""]
                lines += ["```json", value, "```", ""]
    lines += table(
        ("status", "answer", "meaning"),
        [
            (status, _answers(answer), "" if int(status) < 300 else answer["description"])
            for status, answer in operation["responses"].items()
        ],
    )
    return lines


def _answers(answer: Document) -> str:
    return ", ".join(
        _type(content.get("schema", {})) or code(media)
        for media, content in answer.get("content", {}).items()
    )


def _schema(name: str, schema: Document) -> list[str]:
    required = set(schema.get("required", ()))
    rows = [
        (
            code(member) + (" (required)" if member in required else ""),
            _type(value),
            code(json.dumps(value["default"])) if "default" in value else "",
            value.get("description", ""),
        )
        for member, value in schema.get("properties", {}).items()
    ]
    text = schema.get("description", "").replace("``", "`")
    kind = [] if rows else [f"Type: {_type(schema)}", ""]
    head = [f"(schema-{_anchor(name)})=", f"### {name}", "", text, ""]
    return [*head, *kind, *table(("member", "type", "default", "meaning"), rows)]


def _type(schema: Document) -> str:
    """Return a schema's type as Markdown, with links to named schemas."""
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[-1]
        return f"[{name}](#schema-{_anchor(name)})"
    for combination in ("anyOf", "oneOf", "allOf"):
        if combination in schema:
            return " or ".join(dict.fromkeys(_type(part) for part in schema[combination]))
    if "const" in schema:
        return code(json.dumps(schema["const"]))
    if "enum" in schema:
        return ", ".join(code(json.dumps(value)) for value in schema["enum"])
    kind = str(schema.get("type", ""))
    if kind == "array":
        items = schema.get("items") or {}
        return f"array of {_type(items) or 'values'}"
    bounds = [
        f"{sign} {schema[key]:g}"
        for key, sign in (
            ("minimum", "≥"),
            ("exclusiveMinimum", ">"),
            ("maximum", "≤"),
            ("exclusiveMaximum", "<"),
        )
        if key in schema
    ]
    shown = schema.get("format", kind) if kind == "string" else kind
    return ", ".join([shown, *bounds])


def _anchor(name: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in name.lower())
