"""Building blocks of the edge: ids that come another way than through a model."""

import pytest

from compute.errors import InvalidParameter
from service.api.base_models import checked_slug


@pytest.mark.parametrize("text", ["a", "0", "sim", "bar-2", "a" * 63])
def test_an_id_passes(text: str):
    assert checked_slug(text) == text


@pytest.mark.parametrize(
    "text", ["", "a\0b", "\0", "Sim", "-sim", "sim-", "sim\n", "a" * 64, "x y", "ä", "\ud800"]
)
def test_what_is_no_id_is_refused_and_shown(text: str):
    with pytest.raises(InvalidParameter, match="is not an id; an id has 1 to 63") as caught:
        checked_slug(text)
    assert caught.value.context == {"id": text}


def test_a_long_text_is_cut():
    with pytest.raises(InvalidParameter) as caught:
        checked_slug("x" * 100_000)
    assert len(caught.value.detail) < 300
