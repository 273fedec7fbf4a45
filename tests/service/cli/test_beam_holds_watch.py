"""`lumiline beam-holds watch`: what it says while nothing comes."""

import threading
import time
from collections.abc import Iterator
from typing import Any

from lumiline.client.messages import BeamHoldEvent, BeamHoldSample, Frame
from service.cli.beam_holds import _hold_changes, _print_change


def frame(number: int, held: bool) -> Frame:
    cause, reason = ("moved", "1.5 mm off") if held else ("none", None)
    one = BeamHoldSample("chest", held, cause, reason, 0)
    return Frame(number, "sim", number, 0, 0, None, None, None, (), holds=(one,))


class Stalled:
    """A server that says that the beam is on, stands still, and goes on when it is told to."""

    def __init__(self) -> None:
        self.go_on = threading.Event()
        self.ended = threading.Event()

    def __iter__(self) -> Iterator[Any]:
        yield frame(1, held=False)
        yield frame(2, held=False)
        self.go_on.wait(240.0)
        yield frame(3, held=False)
        yield frame(4, held=True)
        self.ended.wait(240.0)


def test_a_beam_is_held_while_no_word_comes_and_each_change_is_told_once() -> None:
    stream = Stalled()
    told = _hold_changes(stream, "chest", time.monotonic() + 600.0, 0.2)  # type: ignore[arg-type]
    first = next(told)
    assert isinstance(first, BeamHoldSample)
    assert not first.held
    assert next(told) is None
    stream.go_on.set()
    assert [one is not None and one.held for one in (next(told), next(told))] == [False, True]
    stream.ended.set()
    assert list(told) == []


def test_lines_have_the_time_at_which_they_came(capsys: Any) -> None:
    change = BeamHoldEvent(1, "sim", "chest", True, "moved", "1 mm off", 5, None, None)
    _print_change("chest", change, as_json=True)
    _print_change("chest", None, as_json=True)
    _print_change("chest", None, as_json=False)
    known, silent, text = capsys.readouterr().out.splitlines()
    assert '"received_at": "20' in known
    assert '"held": true' in silent
    assert text.endswith("HELD  no-data  no word of the server")
