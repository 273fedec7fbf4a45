"""Requests as values: what is no answer to them is told, whatever it is."""

from typing import Any

import pytest

from lumiline.client import UnreadableMessage, documents
from lumiline.client.answer import Answer
from lumiline.client.devices import calls


@pytest.mark.parametrize(
    "page", [None, [], {}, {"items": {}, "total": 0}, {"items": []}, {"items": [], "total": "2"}]
)
def test_what_is_no_list(page: Any) -> None:
    with pytest.raises(UnreadableMessage, match="/api/v1/devices did not answer a list"):
        calls.devices().items(page)


@pytest.mark.parametrize("answer", [None, [], "status", {}, {"state": "running"}])
def test_an_answer_without_what_was_asked_for(answer: Any) -> None:
    with pytest.raises(UnreadableMessage, match='answered without "status"'):
        calls.device_status("sim").read(answer)


def test_an_answer_of_another_kind() -> None:
    with pytest.raises(
        UnreadableMessage, match="no DeviceStatus: Field required at \\('state',\\)"
    ):
        calls.device_status("sim").read({"status": {}})


def test_a_page_is_asked_for_from_an_item_on() -> None:
    asked = calls.calibrations("sim", None).page(200)
    assert asked == {"device": "sim", "limit": 200, "offset": 200}


def test_what_is_answered_has_its_type_in_one_place() -> None:
    kinds = {kind for kind in Answer.__subclasses__() if kind.__module__.startswith("lumiline.")}
    assert len(kinds) > 20
    assert {getattr(documents, kind.__name__, None) for kind in kinds} == kinds
    assert {kind.__name__ for kind in kinds} <= set(documents.__all__)
