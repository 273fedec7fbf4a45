"""What a measurement relies on by name: a tool or registration of the same name is no other."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.api.tools import digitise, registration_markers, registration_surface
from tests.service.api.tools.batches import PIVOT_MM, pose, resting, tool_batch
from tests.service.api.tools.test_capture_and_calibration import IMAGE, registration
from tests.service.api.tools.test_digitise import URL as POINTS
from tests.service.api.tools.test_registration_kinds import MARKERS, URL, by_skin
from tests.service.api.tools.test_tools_api import PATIENT, POINTER, code, made
from tests.service.fake_pipeline import FakePipeline

Do = Callable[[Any], None]


@pytest.fixture
def tools(sqlite_client: Any, live: FakePipeline) -> Any:
    live.records = SimulatedDriver("sim", SimulationSettings()).description
    live.batches = [tool_batch([resting("pointer", 700)])]
    assert made(sqlite_client, PATIENT).status_code == 201
    assert made(sqlite_client, POINTER).status_code == 201
    return sqlite_client


def meanwhile(patch: pytest.MonkeyPatch, module: Any, name: str, do: Callable[[], None]) -> None:
    """Let something happen after ``module.name`` found what it returns."""
    before = getattr(module, name)

    def found(*given: Any) -> Any:
        result = before(*given)
        do()
        return result

    patch.setattr(module, name, found)


def deleted(client: Any, path: str) -> None:
    answer = client.delete(f"/api/v1/{path}")
    assert answer.status_code == 204, answer.text


def again(client: Any, tool: dict[str, Any]) -> None:
    """Another tool of the name: its markers are 100 mm further."""
    deleted(client, f"tools/{tool['id']}")
    moved = [[x + 100.0, y, z] for x, y, z in tool["markers_mm"]]
    assert made(client, tool, markers_mm=moved).status_code == 201


def parent(client: Any, **changes: Any) -> None:
    body = registration(IMAGE + PIVOT_MM, measured_sigma_mm=0.1, reference_id="patient") | changes
    answer = client.post(URL, json=body)
    assert answer.status_code == 201, answer.text


def parent_again(client: Any) -> None:
    deleted(client, "registrations/ct")
    parent(client)


def parent_deleted(client: Any) -> None:
    deleted(client, "registrations/ct")


def parent_and_reference_again(client: Any) -> None:
    deleted(client, "registrations/ct")
    again(client, PATIENT)


def reference_again(client: Any) -> None:
    again(client, PATIENT)


def pointer_again(client: Any) -> None:
    again(client, POINTER)


def no_pointer(client: Any) -> None:
    deleted(client, "tools/pointer")


def another_tip(client: Any) -> None:
    answer = client.patch("/api/v1/tools/pointer", json={"tip_mm": [0.0, 0.0, -90.0]})
    assert answer.status_code == 200, answer.text


def nothing(client: Any) -> None:
    """What does not matter: the notes."""
    for tool in ("patient", "pointer"):
        client.patch(f"/api/v1/tools/{tool}", json={"note": "looked at"})


PARENTS: list[tuple[Do, tuple[int, str] | None]] = [
    (parent_again, (409, "registration-replaced")),
    (parent_deleted, (409, "registration-replaced")),
    (parent_and_reference_again, (409, "tool-replaced")),
    (nothing, None),
]


@pytest.mark.slow
def test_a_refined_registration_is_of_the_parent_that_it_began_with(
    tools: Any, monkeypatch: pytest.MonkeyPatch
):
    result = {
        "matrix": np.eye(4).tolist(), "covariance": np.eye(6).tolist(), "targets": [],
        "warnings": [],
    }  # fmt: skip
    # What is found does not matter here, and takes long.
    monkeypatch.setattr(registration_surface, "refine_by_surface", lambda *_: result)
    for do, problem in PARENTS:
        tools.delete(f"{URL}/ct")
        parent(tools)
        with monkeypatch.context() as patch:
            meanwhile(patch, registration_surface, "refine_by_surface", lambda do=do: do(tools))
            answer = tools.post(URL, json=by_skin())
        if problem is None:
            assert (answer.status_code, answer.json()["reference_id"]) == (201, "patient")
            continue
        assert code(answer) == problem, answer.text
        assert tools.get(f"{URL}/skin").status_code == 404


def test_markers_are_relative_to_the_tool_that_they_were_measured_with(
    tools: Any, monkeypatch: pytest.MonkeyPatch
):
    body = MARKERS | {"reference_id": "patient"}
    with monkeypatch.context() as patch:
        meanwhile(patch, registration_markers, "of_markers", lambda: reference_again(tools))
        answer = tools.post(URL, json=body)
    assert code(answer) == (409, "tool-replaced"), answer.text
    assert '"patient"' in answer.json()["detail"]
    assert tools.get(f"{URL}/plate").status_code == 404
    assert tools.post(URL, json=body).status_code == 201


POINTERS: list[tuple[str | None, Do, tuple[int, str] | None]] = [
    ("ct", parent_deleted, (409, "registration-replaced")),
    ("ct", nothing, None),
    ("patient", reference_again, (409, "tool-replaced")),
    (None, pointer_again, (409, "tool-replaced")),
    (None, another_tip, (409, "tool-replaced")),
    (None, no_pointer, (404, "unknown-tool")),
]


@pytest.mark.slow
def test_a_point_is_of_the_pointer_and_the_frame_that_it_was_begun_with(
    tools: Any, live: FakePipeline, monkeypatch: pytest.MonkeyPatch
):
    patient = [pose("patient", n, np.eye(3), np.zeros(3)) for n in range(700)]
    live.batches = [tool_batch([resting("pointer", 700), patient])]
    for frame, do, problem in POINTERS:
        if frame == "ct":
            parent(tools, reference_id=None)
        with monkeypatch.context() as patch:
            meanwhile(patch, digitise, "digitise_point", lambda do=do: do(tools))
            # The reference is 1.5 m from the tip: its turns are tenths of a millimetre there.
            answer = tools.post(POINTS, json={"frame_id": frame, "max_sigma_mm": 1.0})
        if frame == "ct":
            tools.delete(f"{URL}/ct")
        if problem is None:
            assert answer.status_code == 200, answer.text
            assert answer.json()["frame_id"] == frame
            continue
        assert code(answer) == problem, answer.text
        assert "position_mm" not in answer.text
