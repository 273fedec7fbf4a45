"""Requests about recordings, their exports, and runs."""

import time
from pathlib import Path
from typing import Any

from lumiline.client.exchange import (
    ClientMethod,
    Exchange,
    Pause,
    delete,
    download,
    get,
    get_all,
    send,
)
from lumiline.client.models import Export, Recording, Run


class RecordingMethods:
    """Requests about recordings, their exports, and runs."""

    @ClientMethod
    def recordings(self, device_id: str | None = None) -> Exchange[list[Recording]]:
        """Recordings, newest first; of one device."""
        return get_all(Recording, "recordings", device=device_id)

    @ClientMethod
    def recording(self, name: str) -> Exchange[Recording]:
        """One recording."""
        return get(Recording, "recordings", name)

    @ClientMethod
    def start_recording(
        self, device_id: str, name: str | None = None, seconds: float | None = None
    ) -> Exchange[Recording]:
        """Record a running device from its next frame on."""
        body = {"name": name, "seconds": seconds}
        return send(Recording, "POST", "devices", device_id, "recordings", body=body)

    @ClientMethod
    def stop_recording(self, name: str) -> Exchange[Recording]:
        """End a recording."""
        return send(Recording, "POST", "recordings", name, "stop")

    @ClientMethod
    def download_recording(self, name: str, path: Path | str) -> Exchange[Path]:
        """Write a complete recording to a file, which exists only when it is whole."""
        return download(path, "recordings", name, "file")

    @ClientMethod
    def start_export(
        self, /, recording: str, device_id: str, file_format: str, **members: Any
    ) -> Exchange[Run]:
        """Have points, tracks and tool poses of a recording written to a file on the server.

        Args:
            recording: its name.
            device_id: the device whose tools and settings of tracking are used.
            file_format: ``c3d``, ``trc``, ``csv``, ``parquet`` or ``igs.mha``.
            members: others of the request, such as ``result_id``, ``tools``, ``calibration``.

        Returns:
            The run, for ``wait_for_run``; its ``result_id`` is then the export's id.
        """
        body = {**members, "recording": recording, "device": device_id, "format": file_format}
        return send(Run, "POST", "export-runs", body=body)

    @ClientMethod
    def exports(self) -> Exchange[list[Export]]:
        """Files that export runs have made."""
        return get_all(Export, "exports")

    @ClientMethod
    def export(self, export_id: str) -> Exchange[Export]:
        """One export."""
        return get(Export, "exports", export_id)

    @ClientMethod
    def download_export(self, export_id: str, path: Path | str) -> Exchange[Path]:
        """Write an export to a file, which exists only when it is whole."""
        return download(path, "exports", export_id, "file")

    @ClientMethod
    def delete_export(self, export_id: str) -> Exchange[None]:
        """Delete a file that an export run has made."""
        return delete("exports", export_id)

    @ClientMethod
    def run(self, run_id: str) -> Exchange[Run]:
        """State and progress of a run: of an export, a calibration or a map."""
        return get(Run, "runs", run_id)

    @ClientMethod
    def wait_for_run(
        self, run_id: str, timeout_s: float = 600.0, every_s: float = 0.2
    ) -> Exchange[Run]:
        """Wait until a run has ended.

        Args:
            run_id: the run.
            timeout_s: longest time to wait [s]; the run is returned as it is then.
            every_s: time between two requests [s].
        """
        end_s = time.monotonic() + timeout_s
        while True:
            found = yield from get(Run, "runs", run_id)
            if found.ended or time.monotonic() >= end_s:
                return found
            yield Pause(every_s)

    @ClientMethod
    def cancel_run(self, run_id: str) -> Exchange[Run]:
        """End a run that waits or is computed."""
        return send(Run, "POST", "runs", run_id, "cancel")
