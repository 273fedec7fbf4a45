"""Plain clients that ask a server for what pages of the dashboard ask for, and draw nothing.

Run in a process of its own: ``python -m benchmarks.dashboard_clients --clients 3 --seconds 20``
with PageRequests as JSON on standard input.
"""

import argparse
import asyncio
import json
import sys
import time
from dataclasses import dataclass
from typing import Any

import httpx


@dataclass(frozen=True)
class PageRequests:
    """What a page asked for while it was looked at.

    Args:
        streams: addresses and subprotocols of its websockets.
        gets: when it asked for what [s], from the beginning.
        period_s: how long it was looked at: then the same again [s].
    """

    streams: tuple[tuple[str, tuple[str, ...]], ...]
    gets: tuple[tuple[float, str], ...]
    period_s: float

    @classmethod
    def of_json(cls, text: str) -> "PageRequests":
        """Return those that were written as JSON."""
        members = json.loads(text)
        return cls(
            tuple((address, tuple(names)) for address, names in members["streams"]),
            tuple((at_s, url) for at_s, url in members["gets"]),
            members["period_s"],
        )


@dataclass
class Asked:
    """What all clients together received."""

    messages: int = 0
    answers: int = 0
    refused: int = 0


async def _receive(address: str, protocols: tuple[str, ...], into: Asked) -> None:
    """Take messages as a browser does: each as soon as it comes."""
    from websockets.asyncio.client import connect
    from websockets.typing import Subprotocol

    # Compression is offered, as by a browser.
    async with connect(
        address,
        subprotocols=[Subprotocol(name) for name in protocols] or None,
        max_size=None,
        max_queue=None,
    ) as socket:
        async for _ in socket:
            into.messages += 1
    raise RuntimeError(f"the server ended the stream {address}")


async def _ask(requests: PageRequests, delay_s: float, into: Asked) -> None:
    """Send the requests when they are due, again and again; none before the answer to the last."""
    begin = time.monotonic() + delay_s - requests.period_s
    async with httpx.AsyncClient(timeout=60.0) as client:
        while requests.gets:
            begin += requests.period_s
            for due_s, url in requests.gets:
                await asyncio.sleep(max(0.0, begin + due_s - time.monotonic()))
                answer = await client.get(url)
                into.answers += 1
                into.refused += answer.is_error


async def repeat(requests: PageRequests, clients: int, seconds: float) -> dict[str, Any]:
    """Run clients that ask for what a page asked for, and return what they received.

    Args:
        requests: of one page.
        clients: how many.
        seconds: for how long.

    Returns:
        ``messages_per_s`` of a client on average, ``answers`` and those that were ``refused`` of
        all, ``share_of_core``: of this process.

    Raises:
        ExceptionGroup: a stream ended.
    """
    received = Asked()
    begin, used = time.monotonic(), time.process_time()
    try:
        async with asyncio.timeout(seconds), asyncio.TaskGroup() as tasks:
            for number in range(clients):
                # As pages that were opened one after another.
                shift_s = number * requests.period_s / clients
                tasks.create_task(_ask(requests, shift_s % 1.0, received))
                for address, protocols in requests.streams:
                    tasks.create_task(_receive(address, protocols, received))
    except TimeoutError:
        pass
    elapsed = time.monotonic() - begin
    return {
        "clients": clients,
        "messages_per_s": received.messages / elapsed / clients,
        "answers": received.answers,
        "refused": received.refused,
        "share_of_core": (time.process_time() - used) / elapsed,
    }


def main(arguments: list[str] | None = None) -> int:
    """Print what was received as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20.0)
    chosen = parser.parse_args(arguments)
    requests = PageRequests.of_json(sys.stdin.read())
    json.dump(asyncio.run(repeat(requests, chosen.clients, chosen.seconds)), sys.stdout)
    return 0


if __name__ == "__main__":
    sys.exit(main())
