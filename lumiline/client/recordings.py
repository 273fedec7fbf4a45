"""Requests about recordings, their exports, and runs."""

import time
from pathlib import Path
from typing import Any

from lumiline.client.exchange import ClientMethod, Exchanges, result_of
from lumiline.client.models import Export, Recording, Run


class RecordingMethods(Exchanges):
    """Requests about recordings, their exports, and runs."""

    @ClientMethod
    async def recordings(self, device_id: str | None = None) -> list[Recording]:
        """Recordings, newest first; of one device."""
        return await self._get_all(Recording, "recordings", device=device_id)

    @ClientMethod
    async def recording(self, name: str) -> Recording:
        """One recording."""
        return await self._get(Recording, "recordings", name)

    @ClientMethod
    async def start_recording(
        self, device_id: str, name: str | None = None, seconds: float | None = None
    ) -> Recording:
        """Record a running device from its next frame on."""
        body = {"name": name, "seconds": seconds}
        return await self._send(Recording, "POST", "devices", device_id, "recordings", body=body)

    @ClientMethod
    async def stop_recording(self, name: str) -> Recording:
        """End a recording."""
        return await self._send(Recording, "POST", "recordings", name, "stop")

    @ClientMethod
    async def download_recording(self, name: str, path: Path | str) -> Path:
        """Write a complete recording to a file, which exists only when it is whole."""
        return await self._download(path, "recordings", name, "file")

    @ClientMethod
    async def start_export(
        self, /, recording: str, device_id: str, file_format: str, **members: Any
    ) -> Run:
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
        return await self._send(Run, "POST", "export-runs", body=body)

    @ClientMethod
    async def exports(self) -> list[Export]:
        """Files that export runs have made."""
        return await self._get_all(Export, "exports")

    @ClientMethod
    async def export(self, export_id: str) -> Export:
        """One export."""
        return await self._get(Export, "exports", export_id)

    @ClientMethod
    async def download_export(self, export_id: str, path: Path | str) -> Path:
        """Write an export to a file, which exists only when it is whole."""
        return await self._download(path, "exports", export_id, "file")

    @ClientMethod
    async def delete_export(self, export_id: str) -> None:
        """Delete a file that an export run has made."""
        await self._delete("exports", export_id)

    @ClientMethod
    async def run(self, run_id: str) -> Run:
        """State and progress of a run: of an export, a calibration or a map."""
        return await self._get(Run, "runs", run_id)

    @ClientMethod
    async def wait_for_run(
        self, run_id: str, timeout_s: float = 600.0, every_s: float = 0.2
    ) -> Run:
        """Wait until a run has ended.

        Args:
            run_id: the run.
            timeout_s: longest time to wait [s]; the run is returned as it is then.
            every_s: time between two requests [s].
        """
        end_s = time.monotonic() + timeout_s
        while True:
            found = await self._get(Run, "runs", run_id)
            if found.ended or time.monotonic() >= end_s:
                return found
            await result_of(self._sleep(every_s))

    @ClientMethod
    async def cancel_run(self, run_id: str) -> Run:
        """End a run that waits or is computed."""
        return await self._send(Run, "POST", "runs", run_id, "cancel")
