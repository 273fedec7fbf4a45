"""Requests about recordings, their exports, and runs, for both clients."""

from collections.abc import Mapping
from typing import Any

from lumiline.client.api_request import ApiRequest, get, path_of, post
from lumiline.client.recordings import models as d


def recordings(device_id: str | None) -> ApiRequest[d.Recording]:
    """Recordings, the newest first."""
    return get(d.Recording, "recordings", device=device_id)


def recording(name: str) -> ApiRequest[d.Recording]:
    """One recording."""
    return get(d.Recording, "recordings", name)


def start_recording(
    device_id: str, name: str | None, seconds: float | None
) -> ApiRequest[d.Recording]:
    """Record a running device."""
    body = {"name": name, "seconds": seconds}
    return post(d.Recording, "devices", device_id, "recordings", body=body)


def stop_recording(name: str) -> ApiRequest[d.Recording]:
    """End a recording."""
    return post(d.Recording, "recordings", name, "stop")


def recording_file(name: str) -> str:
    """Return the path of a recording's file."""
    return path_of("recordings", name, "file")


def start_export(
    recording: str, device_id: str, file_format: str, members: Mapping[str, Any]
) -> ApiRequest[d.Run]:
    """Write what is in a recording to a file on the server."""
    body = {**members, "recording": recording, "device": device_id, "format": file_format}
    return post(d.Run, "export-runs", body=body)


def exports() -> ApiRequest[d.Export]:
    """All exports."""
    return get(d.Export, "exports")


def export(export_id: str) -> ApiRequest[d.Export]:
    """One export."""
    return get(d.Export, "exports", export_id)


def export_file(export_id: str) -> str:
    """Return the path of an export's file."""
    return path_of("exports", export_id, "file")


def run(run_id: str) -> ApiRequest[d.Run]:
    """How far a run is."""
    return get(d.Run, "runs", run_id)


def cancel_run(run_id: str) -> ApiRequest[d.Run]:
    """End a run."""
    return post(d.Run, "runs", run_id, "cancel")
