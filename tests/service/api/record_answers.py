"""Record the answers to the contract's examples as examples of answers.

``python -m tests.service.api.record_answers`` writes service/api/answer_examples.json: run it where
the answers have changed.
"""

import json
import tempfile
from pathlib import Path
from typing import Any, Final

import jsonschema_rs
import pytest

from service.api.openapi import ANSWER_EXAMPLES
from service.settings import Settings
from tests.openapi_document import openapi_document
from tests.service.api.test_openapi import answers_to_examples, operations

_KEPT_ITEMS: Final = 2
_KEPT_NUMBERS: Final = 16
"""A longer list of numbers is cut to three; vectors and matrices stay whole."""


def success(operation: dict[str, Any]) -> tuple[str, dict[str, Any] | None]:
    """Return the status of an operation's success and the schema of its JSON answer, if any."""
    [status] = [code for code in operation["responses"] if code in ("200", "201", "202", "204")]
    content = operation["responses"][status].get("content", {})
    found: dict[str, Any] | None = content.get("application/json", {}).get("schema")
    return status, found


def whole(schema: dict[str, Any], contract: dict[str, Any]) -> dict[str, Any]:
    """Return a schema with the components that it refers to."""
    return {**schema, "components": contract["components"]}


def shortened(value: Any) -> Any:
    """Return a document with its long lists cut."""
    if isinstance(value, dict):
        return {key: shortened(one) for key, one in value.items()}
    if isinstance(value, list):
        if value and all(isinstance(one, int | float) for one in value):
            return value if len(value) <= _KEPT_NUMBERS else value[:3]
        kept = value[:_KEPT_ITEMS] if len(value) > 6 or isinstance(value[:1], list) else value
        return [shortened(one) for one in kept]
    return value


def main() -> None:
    """Write the file."""
    contract = openapi_document()
    schemas = {
        operation["operationId"]: success(operation) for _, _, operation in operations(contract)
    }
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        for one, answer in answers_to_examples(Settings(data_dir=Path(folder)), patch):
            assert answer.is_success, (one.operation, answer.text)
            status, schema = schemas[one.operation]
            if schema is None or one.operation in found or str(answer.status_code) != status:
                continue
            value = json.loads(answer.text.replace(folder, "/var/lib/lumiline"))
            if one.operation == "create-key":
                value["key"] = f"lumi_{value['id']}_{'x' * 43}"
            validator = jsonschema_rs.validator_for(whole(schema, contract))
            short = shortened(value)
            found[one.operation] = short if validator.is_valid(short) else value
    by_schema = {json.dumps(schemas[name][1]): value for name, value in found.items()}
    for name, (_, schema) in schemas.items():
        if schema is not None and name not in found:
            found[name] = by_schema[json.dumps(schema)]
    text = json.dumps(dict(sorted(found.items())), indent=1, ensure_ascii=False)
    ANSWER_EXAMPLES.write_text(text + "\n", encoding="utf-8")
    print(f"{ANSWER_EXAMPLES}: {len(found)} answers, {len(text) // 1024} KiB")


if __name__ == "__main__":
    main()
