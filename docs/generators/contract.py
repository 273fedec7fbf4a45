"""Snapshot of the REST contract, and what changed against it in ways that break clients.

``python docs/generators/contract.py`` writes docs/reference/contract.json; with ``--check`` it only
says what breaks clients (exit status 1) or that the snapshot is old (status 2). After a deliberate
change write it again, and list the change in the changelog (docs/reference/versions.md).
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SNAPSHOT = Path(__file__).resolve().parents[1] / "reference" / "contract.json"
Document = dict[str, Any]
_COMBINATIONS = ("anyOf", "oneOf", "allOf")
_WORLDS = ("request", "answer")


def shape(document: Document) -> Document:
    """Return what clients depend on: operations, their parameters, bodies and answers, schemas."""
    schemas = document["components"]["schemas"]
    operations: Document = {}
    used: dict[str, set[str]] = {world: set() for world in _WORLDS}
    for path, item in document["paths"].items():
        for method, operation in item.items():
            bodies = _contents(operation.get("requestBody", {}))
            answers = {
                status: _contents(answer)
                for status, answer in operation["responses"].items()
                if status.startswith("2")
            }
            operations[operation["operationId"]] = {
                "request": f"{method.upper()} {path}",
                "parameters": {
                    f"{one['in']} {one['name']}": {
                        "required": one.get("required", False),
                        "kinds": sorted(_kinds(one.get("schema", {}))),
                    }
                    for one in operation.get("parameters", ())
                },
                "body": {media: sorted(_kinds(schema)) for media, schema in bodies.items()},
                "answers": {
                    status: {media: sorted(_kinds(schema)) for media, schema in contents.items()}
                    for status, contents in answers.items()
                },
            }
            for schema in bodies.values():
                _collect(schema, schemas, used["request"])
            for contents in answers.values():
                for schema in contents.values():
                    _collect(schema, schemas, used["answer"])
    return {
        "operations": dict(sorted(operations.items())),
        "schemas": {
            name: {
                "used": [world for world in _WORLDS if name in used[world]],
                "kinds": sorted(_kinds(schema)),
                "required": sorted(schema.get("required", ())),
                "members": {
                    member: sorted(_kinds(value))
                    for member, value in sorted(schema.get("properties", {}).items())
                },
            }
            for name, schema in sorted(schemas.items())
            if name in used["request"] | used["answer"]
        },
    }


def _contents(part: Document) -> dict[str, Document]:
    return {media: one.get("schema", {}) for media, one in part.get("content", {}).items()}


def _collect(schema: Any, schemas: Document, found: set[str]) -> None:
    """Add the names of all schemas that one refers to."""
    if isinstance(schema, list):
        for one in schema:
            _collect(one, schemas, found)
    elif isinstance(schema, dict):
        name = _name(schema)
        if name is not None and name not in found:
            found.add(name)
            _collect(schemas[name], schemas, found)
        for key, value in schema.items():
            if key not in ("example", "examples", "default"):
                _collect(value, schemas, found)


def _name(schema: Document) -> str | None:
    reference = schema.get("$ref")
    return reference.rpartition("/")[2] if isinstance(reference, str) else None


def _kinds(schema: Document) -> set[str]:
    """Return the kinds of value that fit a schema: types, names of schemas, single values."""
    name = _name(schema)
    if name is not None:
        return {name}
    for combination in _COMBINATIONS:
        if combination in schema:
            return set().union(*(_kinds(part) for part in schema[combination]))
    if "const" in schema:
        return {json.dumps(schema["const"])}
    if "enum" in schema:
        return {json.dumps(value) for value in schema["enum"]}
    kind = schema.get("type", "any")
    if kind == "array":
        items = schema.get("items") or {"anyOf": schema.get("prefixItems", [{}])}
        return {f"array of {' or '.join(sorted(_kinds(items)))}"}
    if kind == "object" and isinstance(schema.get("additionalProperties"), dict):
        return {f"object of {' or '.join(sorted(_kinds(schema['additionalProperties'])))}"}
    return {schema.get("format", kind) if kind == "string" else kind}


def breaking_changes(before: Document, now: Document) -> Iterator[str]:
    """Yield what a client of ``before`` may stumble over, one line each; additions are none."""
    for name, old in before["operations"].items():
        new = now["operations"].get(name)
        if new is None:
            yield f"operation {name} ({old['request']}) is gone"
            continue
        yield from _operation(name, old, new)
    for name, old in before["schemas"].items():
        new = now["schemas"].get(name)
        if new is None:
            yield f"schema {name} is gone"
            continue
        yield from _schema(name, old, new)


def _operation(name: str, old: Document, new: Document) -> Iterator[str]:
    if old["request"] != new["request"]:
        yield f"operation {name} is {new['request']}, was {old['request']}"
    for parameter, was in old["parameters"].items():
        there = new["parameters"].get(parameter)
        if there is None:
            yield f"operation {name}: parameter {parameter} is gone"
            continue
        yield from _narrowed(f"operation {name}: parameter {parameter}", was, there["kinds"])
    for parameter, there in new["parameters"].items():
        if there["required"] and not old["parameters"].get(parameter, {}).get("required", False):
            yield f"operation {name}: parameter {parameter} is required"
    for media, kinds in old["body"].items():
        if media not in new["body"]:
            yield f"operation {name} takes no {media}"
        else:
            yield from _narrowed(f"operation {name}: body", {"kinds": kinds}, new["body"][media])
    if new["body"] and not old["body"]:
        yield f"operation {name} needs a body"
    for status, contents in old["answers"].items():
        for media, kinds in contents.items():
            there = new["answers"].get(status, {}).get(media)
            if there is None:
                yield f"operation {name} answers no {status} {media}"
            else:
                yield from _widened(f"operation {name}: answer {status}", kinds, there)
        if status not in new["answers"]:
            yield f"operation {name} answers no {status}"


def _schema(name: str, old: Document, new: Document) -> Iterator[str]:
    sent, received = "request" in old["used"], "answer" in old["used"]
    if not old["members"]:
        if sent:
            yield from _narrowed(f"schema {name}", old, new["kinds"])
        if received:
            yield from _widened(f"schema {name}", old["kinds"], new["kinds"])
    for member, kinds in old["members"].items():
        what = f"{name}.{member}"
        there = new["members"].get(member)
        if there is None:
            yield f"{what} is gone"
            continue
        if sent:
            yield from _narrowed(what, {"kinds": kinds}, there)
        if received:
            yield from _widened(what, kinds, there)
    if sent:
        for member in set(new["required"]) - set(old["required"]):
            yield f"{name}.{member} is required in requests"
    if received:
        for member in set(old["required"]) - set(new["required"]):
            if member in new["members"]:
                yield f"{name}.{member} may be absent from answers"


def _narrowed(what: str, was: Document, now: list[str]) -> Iterator[str]:
    """Yield what may be sent no more."""
    gone = set(was["kinds"]) - set(now)
    if gone and "any" not in now and not (gone == {"integer"} and "number" in now):
        yield f"{what} takes {', '.join(sorted(gone))} no more"


def _widened(what: str, was: list[str], now: list[str]) -> Iterator[str]:
    """Yield what may come that could not before; new values of an enumeration pass."""
    enumerated = any(kind.startswith('"') for kind in was)
    added = {kind for kind in set(now) - set(was) if not (enumerated and kind.startswith('"'))}
    if added and "any" not in was:
        yield f"{what} may be {', '.join(sorted(added))}"


def written(found: Document) -> str:
    """Return a snapshot as text, a line for each operation and schema."""
    parts = [
        f"{json.dumps(part)}: {{\n"
        + ",\n".join(f"{json.dumps(name)}: {json.dumps(one)}" for name, one in entries.items())
        + "\n}"
        for part, entries in found.items()
    ]
    return "{" + ",\n".join(parts) + "}\n"


def main(arguments: list[str]) -> int:
    """Write the snapshot, or check the contract against it."""
    from service.application.app import create_app
    from service.settings import Settings

    now = shape(create_app(Settings.model_construct()).openapi())
    text = written(now)
    if "--check" not in arguments:
        SNAPSHOT.write_text(text, encoding="utf-8")
        return 0
    before = json.loads(SNAPSHOT.read_text(encoding="utf-8"))
    found = sorted(breaking_changes(before, now))
    for line in found:
        print(f"breaks clients: {line}")
    if found:
        return 1
    if before != now:
        print("the contract has additions: run python docs/generators/contract.py")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
