"""`lumiline holds`: beam holds of a running server, through the client."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from math import sqrt
from threading import Timer
from typing import Any

import typer
from rich.table import Table
from rich.text import Text

from lumiline.client import Client
from lumiline.client.documents import HoldState
from lumiline.client.errors import ClientError
from lumiline.client.messages import BeamHold, Hello, HoldChange
from service.cli.output import console, fail, print_json


@contextmanager
def _server(url: str, key: str | None) -> Iterator[Client]:
    """Yield a client; what the server refuses ends the command with its reason."""
    try:
        with Client(url, key) as client:
            yield client
    except ClientError as error:
        raise fail(str(error)) from None


def show_all(url: str, key: str | None, device: str | None, *, as_json: bool) -> None:
    """Print the holds, and whether each is held."""
    with _server(url, key) as client:
        found = [(hold, client.hold_state(hold.id)) for hold in client.holds(device)]
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
    with _server(url, key) as client:
        hold, state = client.hold(hold_id), client.hold_state(hold_id)
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
    with _server(url, key) as client:
        state = client.acknowledge_hold(hold_id)
    if as_json:
        print_json(state.model_dump(mode="json"))
    else:
        _show(state)


def watch(url: str, key: str | None, hold_id: str, seconds: float | None, *, as_json: bool) -> None:
    """Print changes of a hold until the time is over; exit code 1 where it is held then."""
    held = True
    with _server(url, key) as client:
        device = client.hold(hold_id).device
        with client.stream(device, ["holds"], rate_hz=1.0) as stream:
            timer = None if seconds is None else Timer(seconds, stream.close)
            if timer is not None:
                timer.daemon = True
                timer.start()
            try:
                for message in stream:
                    for one in _changes(message, hold_id):
                        held = one.held
                        _line(one, as_json=as_json)
            except KeyboardInterrupt:
                pass
            finally:
                if timer is not None:
                    timer.cancel()
    if held:
        raise typer.Exit(1)


def _changes(message: object, hold_id: str) -> Iterator[BeamHold | HoldChange]:
    """Yield what a message says anew of a hold: a connection begins with how it stands."""
    if isinstance(message, Hello):
        yield from (one for one in message.holds or () if one.hold == hold_id)
    elif isinstance(message, HoldChange) and message.hold == hold_id:
        yield message


def _line(one: BeamHold | HoldChange, *, as_json: bool) -> None:
    if as_json:
        members: dict[str, Any] = asdict(one)
        typer.echo(json.dumps(members))
        return
    at = datetime.fromtimestamp(one.since_ns * 1e-9, UTC).astimezone().strftime("%H:%M:%S.%f")[:-3]
    # A line at once, also into a pipe, and no wrapping: each is one event.
    typer.echo(f"{at}  {'HELD' if one.held else 'on'}  {one.cause}  {one.reason or ''}".rstrip())


def _show(state: HoldState) -> None:
    console.print(f"beam: {_beam(state.held)}, {state.cause}; shift {_length(state)} mm")
    if state.reason:
        console.print(Text(state.reason))


def _beam(held: bool) -> str:
    return "[red]HELD[/red]" if held else "[green]on[/green]"


def _length(state: HoldState) -> str:
    shift = state.shift_mm
    return "-" if shift is None else f"{sqrt(sum(value * value for value in shift)):.2f}"
