"""`lumiline beam-holds`: beam holds of a running server, through the client."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from math import inf, sqrt
from queue import Empty, Queue
from threading import Thread
from time import monotonic
from typing import Any, Final

import typer
from rich.table import Table
from rich.text import Text

from lumiline.client.errors import ClientError
from lumiline.client.messages import BeamHoldEvent, BeamHoldSample, Frame, Hello, Message
from lumiline.client.models import BeamHoldStatus
from lumiline.client.stream import Stream
from service.cli.client_session import client_session
from service.cli.output import console, print_json

MAX_SILENCE_S: Final = 2.0
"""After which a beam counts as held, without a word of the server."""
RATE_HZ: Final = 5.0
"""Of frames, which say that the line is alive."""
SILENT: Final = "no word of the server"


def show_all(url: str, key: str | None, device: str | None, *, as_json: bool) -> None:
    """Print the holds, and whether each is held."""
    with client_session(url, key) as client:
        found = [(hold, client.beam_hold_state(hold.id)) for hold in client.beam_holds(device)]
    if as_json:
        both = [
            {"hold": hold.model_dump(mode="json"), "state": state.model_dump(mode="json")}
            for hold, state in found
        ]
        print_json(both)
        return
    table = Table()
    for heading in ("id", "device", "title", "watches", "beam", "cause", "shift [mm]"):
        table.add_column(heading, overflow="fold")
    for hold, state in found:
        table.add_row(
            hold.id, hold.device, hold.title, hold.watch["kind"], _beam(state.held), state.cause,
            _length(state),
        )  # fmt: skip
    console.print(table)
    for hold, state in found:
        if state.reason:
            console.print(Text(f"{hold.id}: {state.reason}"))


def show_one(url: str, key: str | None, hold_id: str, *, as_json: bool) -> None:
    """Print a hold and its state; exit code 1 where it is held."""
    with client_session(url, key) as client:
        hold, state = client.beam_hold(hold_id), client.beam_hold_state(hold_id)
    if as_json:
        documents = {"hold": hold.model_dump(mode="json"), "state": state.model_dump(mode="json")}
        print_json(documents)
    else:
        console.print(f"{hold.id}: {hold.title}, of device {hold.device}", highlight=False)
        _show(state)
    if state.held:
        raise typer.Exit(1)


def acknowledge(url: str, key: str | None, hold_id: str, *, as_json: bool) -> None:
    """Acknowledge a hold, and print how it stands; it ends with the next frames at the earliest."""
    with client_session(url, key) as client:
        state = client.acknowledge_beam_hold(hold_id)
    if as_json:
        print_json(state.model_dump(mode="json"))
    else:
        _show(state)


def watch(
    url: str,
    key: str | None,
    hold_id: str,
    seconds: float | None,
    *,
    as_json: bool,
    silence_s: float = MAX_SILENCE_S,
) -> None:
    """Print changes of a hold until the time is over; exit code 1 where it is held then.

    A server from which nothing comes for ``silence_s`` says nothing of now: held.
    """
    held = True
    end_s = inf if seconds is None else monotonic() + seconds
    with client_session(url, key) as client:
        device = client.beam_hold(hold_id).device
        with client.stream(device, ["holds"], rate_hz=RATE_HZ) as stream:
            try:
                for one in _hold_changes(stream, hold_id, end_s, silence_s):
                    held = one is None or one.held
                    _line(hold_id, one, as_json=as_json)
            except KeyboardInterrupt:
                pass
    if held:
        raise typer.Exit(1)


def _hold_changes(
    stream: Stream, hold_id: str, end_s: float, silence_s: float
) -> Iterator[BeamHoldSample | BeamHoldEvent | None]:
    """Yield each change of a hold until a time; None: nothing has come for too long."""
    received: Queue[Message | ClientError | None] = Queue()
    Thread(target=_receive, args=(stream, received), daemon=True).start()
    last: tuple[bool, str] | None = None
    while (left_s := end_s - monotonic()) > 0.0:
        try:
            message = received.get(timeout=min(left_s, silence_s))
        except Empty:
            # What is held stays so in silence; a device that is stopped sends no frames.
            if last is not None and not last[0] and left_s > silence_s:
                last = None
                yield None
            continue
        if isinstance(message, ClientError):
            raise message
        if message is None:
            return
        for one in _holds(message, hold_id):
            if isinstance(one, BeamHoldEvent) or (one.held, one.cause) != last:
                yield one
            last = one.held, one.cause


def _receive(stream: Stream, received: "Queue[Message | ClientError | None]") -> None:
    try:
        for message in stream:
            received.put(message)
        received.put(None)
    except ClientError as error:
        received.put(error)


def _holds(message: Message, hold_id: str) -> Iterator[BeamHoldSample | BeamHoldEvent]:
    """Yield what a message says of a hold: a connection begins with how it stands."""
    if isinstance(message, Hello | Frame):
        yield from (one for one in message.holds or () if one.hold == hold_id)
    elif isinstance(message, BeamHoldEvent) and message.hold == hold_id:
        yield message


def _line(hold_id: str, one: BeamHoldSample | BeamHoldEvent | None, *, as_json: bool) -> None:
    """Print a change with the time at which it came."""
    now = datetime.now(UTC)
    if as_json:
        silent = {"hold": hold_id, "held": True, "cause": "no-data", "reason": SILENT}
        members: dict[str, Any] = silent if one is None else asdict(one)
        typer.echo(json.dumps(members | {"received_at": now.isoformat()}))
        return
    at = now.astimezone().strftime("%H:%M:%S.%f")[:-3]
    held, cause, reason = (
        (True, "no-data", SILENT) if one is None else (one.held, one.cause, one.reason)
    )
    # A line at once, also into a pipe, and no wrapping: each is one event.
    typer.echo(f"{at}  {'HELD' if held else 'on'}  {cause}  {reason or ''}".rstrip())


def _show(state: BeamHoldStatus) -> None:
    console.print(f"beam: {_beam(state.held)}, {state.cause}; shift {_length(state)} mm")
    if state.reason:
        console.print(Text(state.reason))


def _beam(held: bool) -> str:
    return "[red]HELD[/red]" if held else "[green]on[/green]"


def _length(state: BeamHoldStatus) -> str:
    shift = state.shift_mm
    return "-" if shift is None else f"{sqrt(sum(value * value for value in shift)):.2f}"
