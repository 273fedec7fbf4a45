"""The grammar of the interface (docs/decisions/0021), held over the whole OpenAPI document."""

import copy
import re
from collections.abc import Callable, Iterator
from typing import Any, Final

import pytest

from tests.openapi_document import openapi_document

Document = dict[str, Any]

RESOURCES: Final = {
    "devices": "device",
    "calibrations": "calibration",
    "correction-tables": "table",
    "radiometric-calibrations": "radiometric",
    "radiometric-captures": "radiometric_capture",
    "captures": "capture",
    "wave-captures": "wave_capture",
    "drift-checks": "drift_check",
    "quality-checks": "quality_check",
    "runs": "run",
    "reconstructions": "reconstruction",
    "recordings": "recording",
    "exports": "export",
    "tools": "tool",
    "registrations": "registration",
    "frames": "frame",
    "beam-holds": "hold",
    "device-profiles": "profile",
    "keys": "key",
    "webhooks": "webhook",
}
"""What a resource is called in ``<word>_id``, by its path."""
ROLES: Final = ("reference", "parent", "start", "drift", "quality", "correction_table", "beam_hold")
"""Other words for an item of a resource, which need ``_id``, too."""
OTHER_PATHS: Final = {"code", "figure"}
"""Parameters of paths that are no id: a problem type, a figure of a report."""
NO_REFERENCE: Final = {
    ("CreatedApiKey", "key"),  # the text of the key, which is a secret
}
STATES: Final = {
    "CalibrationSummary", "CalibrationDocument", "DeviceStateDocument", "LinkState", "Run",
    "RecordingDocument", "RecordingDetail", "ApiKey", "CreatedApiKey", "WebhookState",
    "WaveCapture", "RecordedTrack", "Station",
}  # fmt: skip
"""What lives: schemas that have a ``state``."""
JUDGED: Final = {
    "Pose", "FrameState", "FrameTransform", "DriftCheckSummary", "DriftCheckDocument", "Health",
    "Readiness", "RecordedToolPose",
}  # fmt: skip
"""What is judged: schemas that have a ``status``."""
HTTP_STATUS: Final = {"Problem", "ProblemType", "RunProblem"}
"""Problem documents, whose ``status`` is a number of HTTP."""
SIGMAS_MM: Final = {
    "position_sigma_mm": "of each coordinate of known positions that the request gives",
    "control_position_sigma_mm": "the same, of a plan's calibration beside its other error sources",
    "reference_sigma_mm": "of a known distance",
    "frame_sigma_mm": "of fiducials in the frame of the image",
    "measured_sigma_mm": "of fiducials as the device measured them",
    "mean_sigma_mm": "of found points, on the mean",
    "max_sigma_mm": "of found points, the largest or its limit",
}
"""Members in ``_sigma_mm`` and their quantities: one quantity has one name."""
OTHER_UNITS: Final = {"seconds", "milliseconds", "minutes", "hours"}
"""Words in place of which a name has the unit at its end, such as ``duration_s``."""


def properties(document: Document) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for name, schema in document["components"]["schemas"].items():
        for member, value in schema.get("properties", {}).items():
            yield name.rsplit("__", 1)[-1], member, value


def operations(document: Document) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, item in document["paths"].items():
        for method, operation in item.items():
            yield path, method, operation


def parameters(document: Document, where: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for path, _, operation in operations(document):
        for parameter in operation.get("parameters", []):
            if parameter["in"] == where:
                yield path, parameter


def variants(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for several in ("anyOf", "oneOf"):
        for one in schema.get(several, []):
            yield from variants(one)
    yield schema


def is_text(schema: dict[str, Any]) -> bool:
    """Whether it may be a text of any content, as an id is."""
    return any(
        one.get("type") == "string" and "enum" not in one and "const" not in one
        for one in variants(schema)
    )


def are_texts(schema: dict[str, Any]) -> bool:
    return any(
        one.get("type") == "array" and is_text(one.get("items", {})) for one in variants(schema)
    )


def words() -> set[str]:
    return {*RESOURCES.values(), *ROLES}


def names_a_resource(name: str) -> bool:
    return any(name == word or name.endswith(f"_{word}") for word in words())


def bare_references(document: Document) -> list[Any]:
    found: list[Any] = []
    for schema, member, value in properties(document):
        if (schema, member) in NO_REFERENCE:
            continue
        one = names_a_resource(member) and is_text(value)
        several = member.endswith("s") and names_a_resource(member[:-1]) and are_texts(value)
        if one or several:
            found.append((schema, member))
    found += [
        (path, parameter["name"])
        for path, parameter in parameters(document, "query")
        if names_a_resource(parameter["name"]) and is_text(parameter["schema"])
    ]
    return found


def moments_without_at(document: Document) -> list[Any]:
    return [
        (schema, member)
        for schema, member, value in properties(document)
        if any(one.get("format") == "date-time" for one in variants(value))
        != member.endswith("_at")
        # A number that is as large as a full scale, not a moment.
        and (schema, member) != ("Tcd1304Settings", "saturated_at")
    ]


def lists_without_pages(document: Document) -> list[Any]:
    found = []
    for path, method, operation in operations(document):
        names = {one["name"] for one in operation.get("parameters", [])}
        answer = operation["responses"].get("200", {}).get("content", {})
        schema = answer.get("application/json", {}).get("schema", {})
        page = schema.get("$ref", "").rpartition("/")[2]
        is_list = operation["operationId"].startswith("list-") or schema.get("type") == "array"
        if not is_list and not page.startswith("Page_"):
            continue
        members = document["components"]["schemas"].get(page, {}).get("properties", {})
        whole = method == "get" and set(members) == {"items", "next_cursor"}
        if not whole or not {"limit", "cursor"} <= names or "offset" in names:
            found.append((path, operation["operationId"]))
    return found


def states_and_statuses_mixed(document: Document) -> list[Any]:
    found = []
    for schema, member, value in properties(document):
        if member == "state" and schema not in STATES:
            found.append((schema, member))
        if member == "status":
            numeric = value.get("type") == "integer"
            if schema not in (HTTP_STATUS if numeric else JUDGED):
                found.append((schema, member))
    return found


def keys_of_paths(document: Document) -> list[Any]:
    """Parameters of paths that are not called as references to their resource are."""
    found = []
    for path, parameter in parameters(document, "path"):
        name = parameter["name"]
        before = path.partition(f"/{{{name}}}")[0].rpartition("/")[2]
        wanted = f"{RESOURCES[before]}_id" if before in RESOURCES else None
        if before == "compare":
            wanted = "other_calibration_id"
        if name != wanted and name not in OTHER_PATHS:
            found.append((path, name))
    return found


def items_without_id(document: Document) -> list[Any]:
    """Resources that are read at a path with their key, and have no ``id``."""
    found = []
    for path, method, operation in operations(document):
        resource = re.search(r"/([a-z-]+)/\{\w+_id\}$", path)
        if method != "get" or resource is None or resource[1] == "frames":  # of two frames
            continue
        schema = operation["responses"]["200"]["content"]["application/json"]["schema"]
        name = schema["$ref"].rpartition("/")[2]
        if (
            "compare" not in path
            and "id" not in document["components"]["schemas"][name]["properties"]
        ):
            found.append((path, name))
    return found


def not_snake_case(document: Document) -> list[Any]:
    named = [(schema, member) for schema, member, _ in properties(document)]
    named += [
        (path, one["name"])
        for where in ("path", "query")
        for path, one in parameters(document, where)
    ]
    return [
        (where, name)
        for where, name in named
        if re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) is None
    ]


def sigmas_by_other_names(document: Document) -> list[Any]:
    """Standard deviations in mm under a name that no quantity of SIGMAS_MM has."""
    return [
        (schema, name)
        for schema, name, _ in properties(document)
        if name.endswith("_sigma_mm") and name not in SIGMAS_MM
    ]


def units_written_out(document: Document) -> list[Any]:
    return [
        (schema, member)
        for schema, member, _ in properties(document)
        if OTHER_UNITS & {member, member.rpartition("_")[2]}
    ]


CHECKS: Final[dict[str, Callable[[Document], list[Any]]]] = {
    check.__name__: check
    for check in (
        bare_references, moments_without_at, lists_without_pages, states_and_statuses_mixed,
        keys_of_paths, items_without_id, not_snake_case, units_written_out,
        sigmas_by_other_names,
    )
}  # fmt: skip


@pytest.mark.parametrize("name", CHECKS)
def test_the_document_keeps_the_grammar(name: str) -> None:
    assert CHECKS[name](openapi_document()) == []


def test_the_tables_name_what_there_is() -> None:
    document = openapi_document()
    schemas = {schema for schema, *_ in properties(document)}
    assert schemas >= STATES | JUDGED | HTTP_STATUS | {schema for schema, _ in NO_REFERENCE}
    segments = {segment for path in document["paths"] for segment in path.split("/")}
    assert segments >= set(RESOURCES)
    assert {member for _, member, _ in properties(document)} >= set(SIGMAS_MM)


def text(**more: Any) -> dict[str, Any]:
    return {"type": "string", **more}


def with_member(schema: str, name: str, value: dict[str, Any]) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        document["components"]["schemas"][schema]["properties"][name] = value

    return change


def with_query(path: str, name: str) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        added = {"name": name, "in": "query", "schema": text()}
        document["paths"][path]["get"]["parameters"].append(added)

    return change


def without_id(document: Document) -> None:
    del document["components"]["schemas"]["Device"]["properties"]["id"]


def without_cursor(document: Document) -> None:
    del document["paths"]["/api/v1/devices"]["get"]["parameters"][1]


def with_total(document: Document) -> None:
    members = document["components"]["schemas"]["Page_Device_"]["properties"]
    members["total"] = {"type": "integer"}


def as_bare_list(document: Document) -> None:
    operation = document["paths"]["/api/v1/devices"]["get"]
    operation["operationId"] = "get-all-devices"
    schema = {"type": "array", "items": {"$ref": "#/components/schemas/Device"}}
    operation["responses"]["200"]["content"]["application/json"]["schema"] = schema


def with_name_in_path(document: Document) -> None:
    item = document["paths"].pop("/api/v1/devices/{device_id}")
    item["get"]["parameters"][0]["name"] = "name"
    document["paths"]["/api/v1/devices/{name}"] = item


VIOLATIONS: Final[list[tuple[str, Callable[[Document], None]]]] = [
    ("bare_references", with_member("Run", "device", text())),
    ("bare_references", with_member("Run", "calibration", {"anyOf": [text(), {"type": "null"}]})),
    ("bare_references", with_member("Run", "active_table", text())),
    ("bare_references", with_member("Run", "tools", {"type": "array", "items": text()})),
    ("bare_references", with_query("/api/v1/runs", "device")),
    ("moments_without_at", with_member("Run", "since", text(format="date-time"))),
    ("moments_without_at", with_member("Run", "seen_at", {"type": "number"})),
    ("lists_without_pages", without_cursor),
    ("lists_without_pages", with_total),
    ("lists_without_pages", as_bare_list),
    ("lists_without_pages", with_query("/api/v1/devices", "offset")),
    ("states_and_statuses_mixed", with_member("Device", "status", text())),
    ("states_and_statuses_mixed", with_member("Run", "status", {"type": "integer"})),
    ("states_and_statuses_mixed", with_member("Pose", "state", text())),
    ("keys_of_paths", with_name_in_path),
    ("items_without_id", without_id),
    ("not_snake_case", with_member("Run", "deviceId", text())),
    ("not_snake_case", with_query("/api/v1/runs", "device-id")),
    ("sigmas_by_other_names", with_member("Run", "control_sigma_mm", {"type": "number"})),
    ("units_written_out", with_member("Run", "seconds", {"type": "number"})),
]


@pytest.mark.parametrize(("name", "change"), VIOLATIONS)
def test_each_violation_is_found(name: str, change: Callable[[Document], None]) -> None:
    document = copy.deepcopy(openapi_document())
    change(document)
    assert CHECKS[name](document) != []


def test_every_check_has_a_violation_that_it_finds() -> None:
    assert {name for name, _ in VIOLATIONS} == set(CHECKS)
