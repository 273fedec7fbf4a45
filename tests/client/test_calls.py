"""Requests as values: what is no answer to them is told, whatever it is."""

from typing import Any

import pytest

from lumiline.client import UnreadableMessage, models
from lumiline.client.devices import requests
from lumiline.client.response_model import ResponseModel


@pytest.mark.parametrize(
    "page", [None, [], {}, {"items": {}, "total": 0}, {"items": []}, {"items": [], "total": "2"}]
)
def test_what_is_no_list(page: Any) -> None:
    with pytest.raises(UnreadableMessage, match="/api/v1/devices did not answer a list"):
        requests.devices().items(page)


@pytest.mark.parametrize("answer", [None, [], "status", {}, {"state": "running"}])
def test_an_answer_without_what_was_asked_for(answer: Any) -> None:
    with pytest.raises(UnreadableMessage, match='answered without "status"'):
        requests.device_status("sim").read(answer)


def test_an_answer_of_another_kind() -> None:
    with pytest.raises(
        UnreadableMessage, match="no DeviceStatus: Field required at \\('state',\\)"
    ):
        requests.device_status("sim").read({"status": {}})


def test_a_page_is_asked_for_from_an_item_on() -> None:
    asked = requests.calibrations("sim", None).page(200)
    assert asked == {"device": "sim", "limit": 200, "offset": 200}


def test_what_is_answered_has_its_type_in_one_place() -> None:
    kinds = {
        kind for kind in ResponseModel.__subclasses__() if kind.__module__.startswith("lumiline.")
    }
    assert len(kinds) > 20
    assert {getattr(models, kind.__name__, None) for kind in kinds} == kinds
    assert {kind.__name__ for kind in kinds} <= set(models.__all__)
