"""Pages of lists: every item once, whatever happens between the pages; cursors that are refused."""

import base64
import hashlib
import json
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from service.database.models import ApiKeyRow

KEYS = "/api/v1/keys"
MADE_AT = datetime(2024, 2, 29, 12, 0, 0, 123456, tzinfo=UTC)


def key_row(name: str, minutes: int) -> ApiKeyRow:
    return ApiKeyRow(
        id=name, name=name, digest="0" * 64, scopes=[], created_by="local",
        created_at=MADE_AT + timedelta(minutes=minutes),
    )  # fmt: skip


@pytest.fixture
def keys(client: Any) -> Any:
    """A server with seven keys, of which some were made at the same moment."""
    with client.app.state.database.write() as session:
        session.add_all(
            key_row(name, minutes)
            for name, minutes in zip("gbadcfe", (0, 1, 1, 1, 2, 2, 3), strict=True)
        )
    return client


def pages(client: Any, path: str, **query: Any) -> list[list[dict[str, Any]]]:
    found = []
    cursor = None
    while True:
        given = query | ({} if cursor is None else {"cursor": cursor})
        answer = client.get(path, params=given)
        assert answer.status_code == 200, answer.text
        page = answer.json()
        assert set(page) == {"items", "next_cursor"}
        found.append(page["items"])
        cursor = page["next_cursor"]
        if cursor is None:
            return found


def ids(items: list[dict[str, Any]]) -> str:
    return "".join(item["id"] for item in items)


@pytest.mark.parametrize(("limit", "sizes"), [(1, [1] * 7), (3, [3, 3, 1]), (7, [7]), (200, [7])])
def test_pages_have_every_item_once_in_order(keys: Any, limit: int, sizes: list[int]) -> None:
    found = pages(keys, KEYS, limit=limit)
    assert [len(items) for items in found] == sizes
    assert "".join(map(ids, found)) == "ecfabdg"


def test_what_is_added_or_deleted_meanwhile_moves_nothing(keys: Any) -> None:
    first = keys.get(KEYS, params={"limit": 3}).json()
    assert ids(first["items"]) == "ecf"
    with keys.app.state.database.write() as session:
        session.delete(session.get_one(ApiKeyRow, "f"))  # which the cursor is of
        session.add(key_row("new", 9))
    second = keys.get(KEYS, params={"limit": 3, "cursor": first["next_cursor"]}).json()
    assert ids(second["items"]) == "abd"


def test_lists_of_other_orders(client: Any) -> None:
    for title in ("one", "two", "three"):
        assert client.patch("/api/v1/devices/sim", json={"title": title}).status_code == 200
    found = pages(client, "/api/v1/audit", operation="change-device", limit=2)
    assert [entry["after"]["title"] for items in found for entry in items] == [
        "three", "two", "one"
    ]  # fmt: skip
    profiles = pages(client, "/api/v1/device-profiles", limit=4)
    names = [profile["id"] for items in profiles for profile in items]
    assert len(profiles) > 1
    assert names == sorted(set(names))
    problems = pages(client, "/problems", limit=50)
    assert len(problems) > 1
    assert len({one["code"] for items in problems for one in items}) == sum(map(len, problems))


def cursor_of(*values: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(values).encode()).decode().rstrip("=")


def refusal(client: Any, path: str, cursor: str, **query: Any) -> str:
    answer = client.get(path, params=query | {"cursor": cursor})
    assert answer.status_code == 422, answer.text
    problem = answer.json()
    assert problem["type"] == "/problems/invalid-request"
    assert [error["location"] for error in problem["errors"]] == [["query", "cursor"]]
    detail: str = problem["detail"]
    return detail


@pytest.mark.parametrize(
    "cursor",
    ["", "abc", "ö", "%00", "e30", "bnVsbA", cursor_of(), cursor_of("x"), cursor_of({}, 1),
     cursor_of("x", None), cursor_of("x", [1]), cursor_of("x", True), "[" * 900],
)  # fmt: skip
def test_a_cursor_that_is_none_is_refused(sqlite_client: Any, cursor: str) -> None:
    detail = refusal(sqlite_client, KEYS, cursor)
    assert "must be" in detail
    assert "next_cursor" in detail or "same list" in detail


def test_a_cursor_of_another_list_or_filter_is_refused(sqlite_client: Any) -> None:
    for number in range(3):
        sensors = [{"name": name, "pixels": 64, "pitch_um": 14} for name in "ABC"]
        source = {"kind": "external", "sensors": sensors}
        body = {"id": f"bar-{number}", "title": "A bar", "source": source}
        assert sqlite_client.post("/api/v1/devices", json=body).status_code == 201
    listed = "/api/v1/devices"
    cursor = sqlite_client.get(listed, params={"limit": 1}).json()["next_cursor"]
    assert "same list" in refusal(sqlite_client, "/api/v1/tools", cursor)
    assert "same list" in refusal(sqlite_client, "/api/v1/tools", cursor, device_id="sim")
    assert "same list" in refusal(sqlite_client, "/api/v1/audit", cursor, outcome="done")
    # Another limit is no other list.
    page = sqlite_client.get(listed, params={"limit": 2, "cursor": cursor}).json()
    assert ids(page["items"]) == "bar-1bar-2"


def test_a_cursor_with_other_values_is_refused(sqlite_client: Any) -> None:
    with sqlite_client.app.state.database.write() as session:
        session.add_all(key_row(name, 0) for name in "ab")
    cursor = sqlite_client.get(KEYS, params={"limit": 1}).json()["next_cursor"]
    of = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))[0]
    for values in (
        ("now", "a"),
        ("2024-02-29", "a"),
        ("2024-02-29T12:00:00", "a"),
        (1, "a"),
        ("a",),
    ):
        refusal(sqlite_client, KEYS, cursor_of(of, *values))


@pytest.mark.slow
def test_every_list_refuses_a_cursor_that_is_none(sqlite_client: Any) -> None:
    asked = 0
    for path, item in sqlite_client.get("/openapi.json").json()["paths"].items():
        if not item.get("get", {}).get("operationId", "").startswith("list-"):
            continue
        here = path.replace("{device_id}", "sim").replace("{tool_id}", "pointer")
        refusal(sqlite_client, here, "abc")
        if "{tool_id}" not in path:
            pages(sqlite_client, here, limit=1)
        asked += 1
    assert asked > 20


@pytest.mark.parametrize(
    ("path", "values"),
    [
        ("/api/v1/audit", [10**30]),
        ("/api/v1/audit", [-(10**30)]),
        ("/api/v1/calibrations", ["2020-01-01T00:00:00+00:00", "a\0"]),
        ("/api/v1/calibrations", ["2020-01-01T00:00:00+00:00", "\ud800"]),
        ("/api/v1/calibrations", ["0001-01-01T00:00:00+14:00", "a"]),
        ("/api/v1/calibrations", ["9999-12-31T23:59:59-14:00", "a"]),
        ("/api/v1/tools", ["a\0"]),
    ],
)
def test_forged_cursor_that_no_database_can_compare_with_is_refused(
    client: Any, path: str, values: list[Any]
) -> None:
    of = hashlib.sha256(json.dumps([path, []]).encode()).hexdigest()[:16]
    cursor = base64.urlsafe_b64encode(json.dumps([of, *values]).encode()).decode().rstrip("=")
    assert client.get(path, params={"cursor": cursor}).status_code == 422
