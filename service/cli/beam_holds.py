"""`lumiline beam-holds`: beam holds of a running server, through the client."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from math import hypot, inf
from queue import Empty, Queue
from threading import Thread
from time import monotonic
from typing import Annotated, Any, Final

import typer
from rich.text import Text

from lumiline.client.errors import ClientError
from lumiline.client.messages import BeamHoldEvent, BeamHoldSample, Frame, Hello, Message
from lumiline.client.models import BeamHoldStatus
from lumiline.client.stream import Stream
from service.cli.options import HERE, AsJson, DeviceOption, Key, Url, WatchSeconds
from service.cli.output import console, make_table, print_json, say
from service.cli.server_session import client_session

MAX_SILENCE_S: Final = 2.0
"""Longest time without a message of the server; then the beam counts as held."""
RATE_HZ: Final = 5.0
"""Rate of the frames, which show that the connection is alive."""
SILENT: Final = "no word of the server"

holds = typer.Typer(
    help="Beam holds of a running server, and whether a beam is held.",
    no_args_is_help=True,
    add_completion=False,
)
HoldId = Annotated[str, typer.Argument(help="The hold's id.")]


@holds.command("list")
def show_all(
    device: DeviceOption = None, url: Url = HERE, key: Key = None, as_json: AsJson = False
) -> None:
    """List beam holds, and whether each is held."""
    with client_session(url, key) as client:
        listed = [
            (hold, client.beam_hold_state(hold.id)) for hold in client.beam_holds(device_id=device)
        ]
    if as_json:
        print_json([{"hold": hold, "state": state} for hold, state in listed])
        return
    rows = (
        (hold.id, hold.device_id, hold.title, hold.watch.kind, _beam(state.held), state.cause,
         _shift(state))
        for hold, state in listed
    )  # fmt: skip
    headings = ("id", "device", "title", "watches", "beam", "cause", "shift [mm]")
    console.print(make_table(headings, rows, texts=None))
    for hold, state in listed:
        if state.reason:
            console.print(Text(f"{hold.id}: {state.reason}"))


@holds.command("show")
def show_one(hold: HoldId, url: Url = HERE, key: Key = None, as_json: AsJson = False) -> None:
    """Show a hold and its state; exit code 1 where the beam is held."""
    with client_session(url, key) as client:
        hold_document, state = client.beam_hold(hold), client.beam_hold_state(hold)
    if as_json:
        print_json({"hold": hold_document, "state": state})
    else:
        say(f"{hold_document.id}: {hold_document.title}, of device {hold_document.device_id}")
        _show(state)
    if state.held:
        raise typer.Exit(1)


@holds.command("watch")
def watch(
    hold: HoldId,
    seconds: WatchSeconds = None,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Print each change of a hold as it comes; exit code 1 where the beam is held at the end."""
    held = True
    end_s = inf if seconds is None else monotonic() + seconds
    with client_session(url, key) as client:
        device = client.beam_hold(hold).device_id
        with client.stream(device, ["holds"], rate_hz=RATE_HZ) as stream:
            try:
                for change in _hold_changes(stream, hold, end_s, MAX_SILENCE_S):
                    held = change is None or change.held
                    _print_change(hold, change, as_json=as_json)
            except KeyboardInterrupt:
                pass
    if held:
        raise typer.Exit(1)


@holds.command("acknowledge")
def acknowledge(hold: HoldId, url: Url = HERE, key: Key = None, as_json: AsJson = False) -> None:
    """Let a latched hold end, once all is back."""
    with client_session(url, key) as client:
        state = client.acknowledge_beam_hold(hold)
    if as_json:
        print_json(state)
    else:
        _show(state)


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
        yield from (one for one in message.holds or () if one.hold_id == hold_id)
    elif isinstance(message, BeamHoldEvent) and message.hold_id == hold_id:
        yield message


def _print_change(
    hold_id: str, change: BeamHoldSample | BeamHoldEvent | None, *, as_json: bool
) -> None:
    """Print a change with the time at which it came; None: silence, which holds the beam."""
    now = datetime.now(UTC)
    members: dict[str, Any] = {
        "hold_id": hold_id, "held": True, "cause": "no-data", "reason": SILENT
    }  # fmt: skip
    if change is not None:
        members = asdict(change)
    if as_json:
        typer.echo(json.dumps(members | {"received_at": now.isoformat()}))
        return
    at = now.astimezone().strftime("%H:%M:%S.%f")[:-3]
    # Printed at once, also into a pipe, and not wrapped: each line is one event.
    state = "HELD" if members["held"] else "on"
    typer.echo(f"{at}  {state}  {members['cause']}  {members['reason'] or ''}".rstrip())


def _show(state: BeamHoldStatus) -> None:
    shift = _shift(state) or "-"
    console.print(f"beam: {_beam(state.held)}, {state.cause}; shift {shift} mm")
    if state.reason:
        console.print(Text(state.reason))


def _beam(held: bool) -> str:
    return "[red]HELD[/red]" if held else "[green]on[/green]"


def _shift(state: BeamHoldStatus) -> str | None:
    return None if state.shift_mm is None else f"{hypot(*state.shift_mm):.2f}"
