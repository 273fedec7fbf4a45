"""BodyReader: what a client is told where the process that reads large bodies has ended."""

import asyncio
from threading import Thread
from typing import Any

import pytest

from service.api.json_body import BodyReader
from service.problems.errors import BodyTooLarge, NotReady, WorkerEnded


class EndedProcess:
    """Stands for a CallProcess whose calls end without a result."""

    def __init__(self, *, closed: bool) -> None:
        self.closed = closed

    def call(self, *_: Any, timeout_s: float) -> Any:
        raise WorkerEnded("it has ended")


def read(reader: BodyReader) -> Any:
    return asyncio.run(reader.read(dict[str, int], "application/json", b'{"a": 1}'))


@pytest.mark.parametrize(("closed", "error"), [(True, NotReady), (False, BodyTooLarge)])
def test_end_of_the_server_is_not_told_as_a_large_body(closed: bool, error: type[Exception]):
    reader = BodyReader(1 << 20)
    reader.close()
    reader._process = EndedProcess(closed=closed)  # type: ignore[assignment]
    with pytest.raises(error, match="it has ended"):
        read(reader)


def test_body_that_is_read_when_the_server_ends_may_be_sent_again():
    reader = BodyReader(1 << 20)
    closing = Thread(target=reader.close)
    closing.start()
    closing.join()
    with pytest.raises(NotReady, match="send this again"):
        read(reader)
