"""Client's methods for recordings, their exports, and runs."""

import time
from pathlib import Path
from typing import Any

from lumiline.client.connection import Connection
from lumiline.client.recordings import models as d
from lumiline.client.recordings import requests


class RecordingMethods(Connection):
    """Recordings, their exports, and runs."""

    def recordings(self, device_id: str | None = None) -> list[d.Recording]:
        """Recordings, of a device, the newest first."""
        return self._all(requests.recordings(device_id))

    def recording(self, name: str) -> d.Recording:
        """One recording."""
        return self._one(requests.recording(name))

    def start_recording(
        self, device_id: str, name: str | None = None, seconds: float | None = None
    ) -> d.Recording:
        """Record a running device from its next frame on."""
        return self._one(requests.start_recording(device_id, name, seconds))

    def stop_recording(self, name: str) -> d.Recording:
        """End a recording."""
        return self._one(requests.stop_recording(name))

    def download_recording(self, name: str, path: Path | str) -> Path:
        """Write a recording that is complete to a file, which is there only when it is whole.

        Raises:
            ServerProblem: there is no such recording, or it is still written.
            ServerUnreachable: the connection was lost before the end.
        """
        return self._download(requests.recording_file(name), path, f"recording {name}")

    def start_export(
        self, recording: str, device_id: str, file_format: str, **members: Any
    ) -> d.Run:
        """Have points, tracks and tool poses of a recording written to a file on the server.

        Args:
            recording: its name.
            device_id: whose tools are followed, as its settings of tracking say.
            file_format: ``c3d``, ``trc``, ``csv``, ``parquet`` or ``igs.mha``.
            members: others of the request, such as ``result_id``, ``tools``, ``calibration``.

        Returns:
            The run, for ``wait_for_run``; its ``result_id`` is then the export's id.
        """
        return self._one(requests.start_export(recording, device_id, file_format, members))

    def exports(self) -> list[d.Export]:
        """Files that export runs have made."""
        return self._all(requests.exports())

    def export(self, export_id: str) -> d.Export:
        """One of them."""
        return self._one(requests.export(export_id))

    def download_export(self, export_id: str, path: Path | str) -> Path:
        """Write an export to a file, which is there only when it is whole.

        Raises:
            ServerProblem: there is no such export.
            ServerUnreachable: the connection was lost before the end.
        """
        return self._download(requests.export_file(export_id), path, f"export {export_id}")

    def delete_export(self, export_id: str) -> None:
        """Delete a file that an export run has made."""
        self.request("DELETE", requests.export(export_id).path)

    def run(self, run_id: str) -> d.Run:
        """How far a run is: of an export, a calibration or a map."""
        return self._one(requests.run(run_id))

    def wait_for_run(self, run_id: str, timeout_s: float = 600.0, every_s: float = 0.2) -> d.Run:
        """Return a run when it has ended, in whatever way, or as it is after so long."""
        end = time.monotonic() + timeout_s
        while not (found := self.run(run_id)).ended and time.monotonic() < end:
            time.sleep(every_s)
        return found

    def cancel_run(self, run_id: str) -> d.Run:
        """End a run that waits or is computed."""
        return self._one(requests.cancel_run(run_id))
