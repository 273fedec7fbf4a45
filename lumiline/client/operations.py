"""A method for each operation of the server's interface."""

# Made from the OpenAPI document by docs/generators/client_code.py; edit nothing here.
# ruff: noqa: A002  (parameters have the interface's names)
from datetime import datetime
from pathlib import Path
from typing import Literal, Unpack

from lumiline.client import bodies, models
from lumiline.client.exchange import ClientMethod, Exchanges, path_of


class Operations(Exchanges):
    """A method for each operation of the server's interface; raises what ``request`` does.

    ``limit``: at most this many items of a list, None: all. ``members``: those of the body, as in
    the server's documentation.
    """

    @ClientMethod
    async def devices(self, *, limit: int | None = None) -> list[models.Device]:
        """List devices."""
        return await self._get_all(models.Device, "/api/v1/devices", limit=limit)

    @ClientMethod
    async def create_device(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewDevice]
    ) -> models.Device:
        """Create a device."""
        return await self._send(
            models.Device,
            "POST",
            "/api/v1/devices",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def device(self, device_id: str) -> models.Device:
        """Read a device."""
        return await self._send(models.Device, "GET", path_of("/api/v1/devices/{}", device_id))

    @ClientMethod
    async def change_device(
        self,
        device_id: str,
        /,
        *,
        if_match: str | None = None,
        **members: Unpack[bodies.DeviceChange],
    ) -> models.Device:
        """Change a device."""
        return await self._send(
            models.Device,
            "PATCH",
            path_of("/api/v1/devices/{}", device_id),
            body=members,
            headers={"If-Match": if_match},
        )

    @ClientMethod
    async def delete_device(
        self, device_id: str, *, cascade: bool | None = None, if_match: str | None = None
    ) -> None:
        """Delete a device."""
        await self._request(
            "DELETE",
            path_of("/api/v1/devices/{}", device_id),
            params={"cascade": cascade},
            headers={"If-Match": if_match},
        )

    @ClientMethod
    async def start_device(self, device_id: str) -> models.DeviceStateDocument:
        """Start a device."""
        return await self._send(
            models.DeviceStateDocument, "POST", path_of("/api/v1/devices/{}/start", device_id)
        )

    @ClientMethod
    async def stop_device(self, device_id: str) -> models.DeviceStateDocument:
        """Stop a device."""
        return await self._send(
            models.DeviceStateDocument, "POST", path_of("/api/v1/devices/{}/stop", device_id)
        )

    @ClientMethod
    async def device_state(self, device_id: str) -> models.DeviceStateDocument:
        """What a device is doing."""
        return await self._send(
            models.DeviceStateDocument, "GET", path_of("/api/v1/devices/{}/state", device_id)
        )

    @ClientMethod
    async def roll_back_device(
        self, device_id: str, *, expected: str | None = None
    ) -> models.Device:
        """Go back to what was active before."""
        return await self._send(
            models.Device,
            "POST",
            path_of("/api/v1/devices/{}/roll-back", device_id),
            params={"expected": expected},
        )

    @ClientMethod
    async def activations(
        self, device_id: str, *, limit: int | None = None
    ) -> list[models.Activation]:
        """History of active calibrations."""
        return await self._get_all(
            models.Activation, path_of("/api/v1/devices/{}/activations", device_id), limit=limit
        )

    @ClientMethod
    async def calibrations(
        self,
        *,
        device_id: str | None = None,
        state: Literal["active", "available", "retired"] | None = None,
        limit: int | None = None,
    ) -> list[models.CalibrationSummary]:
        """List calibrations."""
        return await self._get_all(
            models.CalibrationSummary,
            "/api/v1/calibrations",
            params={"device_id": device_id, "state": state},
            limit=limit,
        )

    @ClientMethod
    async def create_calibration(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewCalibration]
    ) -> models.CalibrationDocument:
        """Calibrate a device."""
        return await self._send(
            models.CalibrationDocument,
            "POST",
            "/api/v1/calibrations",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def calibration(self, calibration_id: str) -> models.CalibrationDocument:
        """Read a calibration."""
        return await self._send(
            models.CalibrationDocument, "GET", path_of("/api/v1/calibrations/{}", calibration_id)
        )

    @ClientMethod
    async def delete_calibration(self, calibration_id: str) -> None:
        """Delete a calibration."""
        await self._request("DELETE", path_of("/api/v1/calibrations/{}", calibration_id))

    @ClientMethod
    async def compare_calibrations(
        self, calibration_id: str, other_calibration_id: str
    ) -> models.ComparisonDocument:
        """Compare two calibrations."""
        return await self._send(
            models.ComparisonDocument,
            "GET",
            path_of("/api/v1/calibrations/{}/compare/{}", calibration_id, other_calibration_id),
        )

    @ClientMethod
    async def activate_calibration(
        self, calibration_id: str, *, expected: str | None = None
    ) -> models.CalibrationSummary:
        """Activate a calibration."""
        return await self._send(
            models.CalibrationSummary,
            "POST",
            path_of("/api/v1/calibrations/{}/activate", calibration_id),
            params={"expected": expected},
        )

    @ClientMethod
    async def retire_calibration(self, calibration_id: str) -> models.CalibrationSummary:
        """Retire a calibration."""
        return await self._send(
            models.CalibrationSummary,
            "POST",
            path_of("/api/v1/calibrations/{}/retire", calibration_id),
        )

    @ClientMethod
    async def create_nominal_calibration(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewNominalCalibration]
    ) -> models.CalibrationDocument:
        """Calibrate a simulated device by its profile."""
        return await self._send(
            models.CalibrationDocument,
            "POST",
            "/api/v1/nominal-calibrations",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def calibration_report(
        self, calibration_id: str, file: Path | str, *, previous_calibration_id: str | None = None
    ) -> Path:
        """The report of a calibration."""
        return await self._download(
            "GET",
            file,
            path_of("/api/v1/calibrations/{}/report.html", calibration_id),
            params={"previous_calibration_id": previous_calibration_id},
        )

    @ClientMethod
    async def calibration_figure(
        self,
        calibration_id: str,
        figure: str,
        file: Path | str,
        *,
        previous_calibration_id: str | None = None,
    ) -> Path:
        """One figure of a calibration's report."""
        return await self._download(
            "GET",
            file,
            path_of("/api/v1/calibrations/{}/report/{}.png", calibration_id, figure),
            params={"previous_calibration_id": previous_calibration_id},
        )

    @ClientMethod
    async def create_calibration_run(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewCalibrationRun]
    ) -> models.Run:
        """Calibrate a device beside the requests."""
        return await self._send(
            models.Run,
            "POST",
            "/api/v1/runs/calibration",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def create_mapping_run(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewMappingRun]
    ) -> models.Run:
        """Map the volume beside the requests."""
        return await self._send(
            models.Run,
            "POST",
            "/api/v1/runs/mapping",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def create_self_calibration_run(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewSelfCalibrationRun]
    ) -> models.Run:
        """Calibrate a device without known coordinates."""
        return await self._send(
            models.Run,
            "POST",
            "/api/v1/runs/self-calibration",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def create_update_run(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewUpdateRun]
    ) -> models.Run:
        """Bring a calibration up to date by still markers."""
        return await self._send(
            models.Run,
            "POST",
            "/api/v1/runs/update",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def create_export_run(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewExportRun]
    ) -> models.Run:
        """Export a recording beside the requests."""
        return await self._send(
            models.Run,
            "POST",
            "/api/v1/runs/export",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def runs(
        self,
        *,
        device_id: str | None = None,
        kind: Literal["calibration", "self-calibration", "update", "mapping", "export"]
        | None = None,
        state: Literal["queued", "running", "succeeded", "failed", "cancelled", "interrupted"]
        | None = None,
        limit: int | None = None,
    ) -> list[models.Run]:
        """List runs."""
        return await self._get_all(
            models.Run,
            "/api/v1/runs",
            params={"device_id": device_id, "kind": kind, "state": state},
            limit=limit,
        )

    @ClientMethod
    async def run(self, run_id: str) -> models.Run:
        """How far a run is."""
        return await self._send(models.Run, "GET", path_of("/api/v1/runs/{}", run_id))

    @ClientMethod
    async def delete_run(self, run_id: str) -> None:
        """Delete a run."""
        await self._request("DELETE", path_of("/api/v1/runs/{}", run_id))

    @ClientMethod
    async def cancel_run(self, run_id: str) -> models.Run:
        """Cancel a run."""
        return await self._send(models.Run, "POST", path_of("/api/v1/runs/{}/cancel", run_id))

    @ClientMethod
    async def captures(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.Capture]:
        """List capture sessions."""
        return await self._get_all(
            models.Capture, "/api/v1/captures", params={"device_id": device_id}, limit=limit
        )

    @ClientMethod
    async def create_capture(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewCapture]
    ) -> models.Capture:
        """Begin a capture session."""
        return await self._send(
            models.Capture,
            "POST",
            "/api/v1/captures",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def capture(self, capture_id: str) -> models.Capture:
        """What is captured and what is left."""
        return await self._send(models.Capture, "GET", path_of("/api/v1/captures/{}", capture_id))

    @ClientMethod
    async def delete_capture(self, capture_id: str) -> None:
        """Delete a capture session."""
        await self._request("DELETE", path_of("/api/v1/captures/{}", capture_id))

    @ClientMethod
    async def capture_target(self, capture_id: str, *, target: str | None = None) -> models.Capture:
        """Capture the next target."""
        return await self._send(
            models.Capture,
            "POST",
            path_of("/api/v1/captures/{}/capture", capture_id),
            params={"target": target},
            extra_timeout_s=60.0,
        )

    @ClientMethod
    async def wave_captures(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.WaveCapture]:
        """List captures of waved wands and bodies."""
        return await self._get_all(
            models.WaveCapture,
            "/api/v1/wave-captures",
            params={"device_id": device_id},
            limit=limit,
        )

    @ClientMethod
    async def create_wave_capture(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewWaveCapture]
    ) -> models.WaveCapture:
        """Begin a capture of a waved wand or body."""
        return await self._send(
            models.WaveCapture,
            "POST",
            "/api/v1/wave-captures",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def wave_capture(self, wave_capture_id: str) -> models.WaveCapture:
        """What is covered and what is missing."""
        return await self._send(
            models.WaveCapture, "GET", path_of("/api/v1/wave-captures/{}", wave_capture_id)
        )

    @ClientMethod
    async def delete_wave_capture(self, wave_capture_id: str) -> None:
        """Cancel or delete a capture."""
        await self._request("DELETE", path_of("/api/v1/wave-captures/{}", wave_capture_id))

    @ClientMethod
    async def start_wave_capture(self, wave_capture_id: str) -> models.WaveCapture:
        """Take poses while it is waved."""
        return await self._send(
            models.WaveCapture, "POST", path_of("/api/v1/wave-captures/{}/start", wave_capture_id)
        )

    @ClientMethod
    async def stop_wave_capture(self, wave_capture_id: str) -> models.WaveCapture:
        """Take no more poses."""
        return await self._send(
            models.WaveCapture, "POST", path_of("/api/v1/wave-captures/{}/stop", wave_capture_id)
        )

    @ClientMethod
    async def radiometric_captures(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.RadiometricCapture]:
        """List sessions of dark and flat captures."""
        return await self._get_all(
            models.RadiometricCapture,
            "/api/v1/radiometric-captures",
            params={"device_id": device_id},
            limit=limit,
        )

    @ClientMethod
    async def create_radiometric_capture(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewRadiometricCapture]
    ) -> models.RadiometricCapture:
        """Begin dark and flat captures."""
        return await self._send(
            models.RadiometricCapture,
            "POST",
            "/api/v1/radiometric-captures",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def radiometric_capture(self, radiometric_capture_id: str) -> models.RadiometricCapture:
        """What is captured and what is next."""
        return await self._send(
            models.RadiometricCapture,
            "GET",
            path_of("/api/v1/radiometric-captures/{}", radiometric_capture_id),
        )

    @ClientMethod
    async def delete_radiometric_capture(self, radiometric_capture_id: str) -> None:
        """Delete a session of captures."""
        await self._request(
            "DELETE", path_of("/api/v1/radiometric-captures/{}", radiometric_capture_id)
        )

    @ClientMethod
    async def capture_radiometric_frames(
        self,
        radiometric_capture_id: str,
        *,
        kind: Literal["dark", "flat"] | None = None,
        name: str | None = None,
        temperature_c: float | None = None,
        relative_light: float | None = None,
    ) -> models.RadiometricCapture:
        """Capture dark or flat frames."""
        return await self._send(
            models.RadiometricCapture,
            "POST",
            path_of("/api/v1/radiometric-captures/{}/capture", radiometric_capture_id),
            params={
                "kind": kind,
                "name": name,
                "temperature_c": temperature_c,
                "relative_light": relative_light,
            },
            extra_timeout_s=120.0,
        )

    @ClientMethod
    async def radiometric_calibrations(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.RadiometricCalibrationSummary]:
        """List radiometric calibrations."""
        return await self._get_all(
            models.RadiometricCalibrationSummary,
            "/api/v1/radiometric-calibrations",
            params={"device_id": device_id},
            limit=limit,
        )

    @ClientMethod
    async def create_radiometric_calibration(
        self,
        *,
        idempotency_key: str | None = None,
        **members: Unpack[bodies.NewRadiometricCalibration],
    ) -> models.RadiometricCalibrationSummary:
        """Calibrate the pixels of a device's sensors."""
        return await self._send(
            models.RadiometricCalibrationSummary,
            "POST",
            "/api/v1/radiometric-calibrations",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def radiometric_calibration(
        self, radiometric_id: str
    ) -> models.RadiometricCalibrationDocument:
        """Read a radiometric calibration."""
        return await self._send(
            models.RadiometricCalibrationDocument,
            "GET",
            path_of("/api/v1/radiometric-calibrations/{}", radiometric_id),
        )

    @ClientMethod
    async def delete_radiometric_calibration(self, radiometric_id: str) -> None:
        """Delete a radiometric calibration."""
        await self._request(
            "DELETE", path_of("/api/v1/radiometric-calibrations/{}", radiometric_id)
        )

    @ClientMethod
    async def activate_radiometric_calibration(
        self, radiometric_id: str, *, expected: str | None = None
    ) -> models.RadiometricCalibrationSummary:
        """Activate a radiometric calibration."""
        return await self._send(
            models.RadiometricCalibrationSummary,
            "POST",
            path_of("/api/v1/radiometric-calibrations/{}/activate", radiometric_id),
            params={"expected": expected},
        )

    @ClientMethod
    async def deactivate_radiometric_calibration(
        self, radiometric_id: str
    ) -> models.RadiometricCalibrationSummary:
        """Stop using a radiometric calibration."""
        return await self._send(
            models.RadiometricCalibrationSummary,
            "POST",
            path_of("/api/v1/radiometric-calibrations/{}/deactivate", radiometric_id),
        )

    @ClientMethod
    async def radiometric_activations(
        self, device_id: str, *, limit: int | None = None
    ) -> list[models.RadiometricActivation]:
        """History of active radiometric calibrations."""
        return await self._get_all(
            models.RadiometricActivation,
            path_of("/api/v1/devices/{}/radiometric-activations", device_id),
            limit=limit,
        )

    @ClientMethod
    async def create_drift_check(
        self,
        calibration_id: str,
        /,
        *,
        idempotency_key: str | None = None,
        **members: Unpack[bodies.NewDriftCheck],
    ) -> models.DriftCheckDocument:
        """Is a calibration still good?."""
        return await self._send(
            models.DriftCheckDocument,
            "POST",
            path_of("/api/v1/calibrations/{}/drift-checks", calibration_id),
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def drift_checks(
        self,
        *,
        device_id: str | None = None,
        calibration_id: str | None = None,
        good: bool | None = None,
        limit: int | None = None,
    ) -> list[models.DriftCheckSummary]:
        """List drift checks."""
        return await self._get_all(
            models.DriftCheckSummary,
            "/api/v1/drift-checks",
            params={"device_id": device_id, "calibration_id": calibration_id, "good": good},
            limit=limit,
        )

    @ClientMethod
    async def drift_check(self, drift_check_id: str) -> models.DriftCheckDocument:
        """Read a drift check."""
        return await self._send(
            models.DriftCheckDocument, "GET", path_of("/api/v1/drift-checks/{}", drift_check_id)
        )

    @ClientMethod
    async def delete_drift_check(self, drift_check_id: str) -> None:
        """Delete a drift check."""
        await self._request("DELETE", path_of("/api/v1/drift-checks/{}", drift_check_id))

    @ClientMethod
    async def correction_tables(
        self,
        *,
        device_id: str | None = None,
        calibration_id: str | None = None,
        limit: int | None = None,
    ) -> list[models.CorrectionTableDocument]:
        """List correction tables."""
        return await self._get_all(
            models.CorrectionTableDocument,
            "/api/v1/correction-tables",
            params={"device_id": device_id, "calibration_id": calibration_id},
            limit=limit,
        )

    @ClientMethod
    async def upload_correction_table(
        self,
        file: Path | str,
        *,
        id: str | None = None,
        note: str | None = None,
        idempotency_key: str | None = None,
    ) -> models.CorrectionTableDocument:
        """Upload a correction table."""
        return await self._send(
            models.CorrectionTableDocument,
            "POST",
            "/api/v1/correction-tables",
            upload=file,
            params={"id": id, "note": note},
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def correction_table(self, table_id: str) -> models.CorrectionTableDocument:
        """Read a correction table."""
        return await self._send(
            models.CorrectionTableDocument, "GET", path_of("/api/v1/correction-tables/{}", table_id)
        )

    @ClientMethod
    async def delete_correction_table(self, table_id: str) -> None:
        """Delete a correction table."""
        await self._request("DELETE", path_of("/api/v1/correction-tables/{}", table_id))

    @ClientMethod
    async def download_correction_table(self, table_id: str, file: Path | str) -> Path:
        """Download a correction table."""
        return await self._download(
            "GET", file, path_of("/api/v1/correction-tables/{}/file", table_id)
        )

    @ClientMethod
    async def activate_correction_table(
        self, table_id: str, *, expected: str | None = None
    ) -> models.CorrectionTableDocument:
        """Activate a correction table."""
        return await self._send(
            models.CorrectionTableDocument,
            "POST",
            path_of("/api/v1/correction-tables/{}/activate", table_id),
            params={"expected": expected},
        )

    @ClientMethod
    async def deactivate_correction_table(self, table_id: str) -> models.CorrectionTableDocument:
        """Stop using a correction table."""
        return await self._send(
            models.CorrectionTableDocument,
            "POST",
            path_of("/api/v1/correction-tables/{}/deactivate", table_id),
        )

    @ClientMethod
    async def reconstructions(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.ReconstructionSummary]:
        """List reconstructions."""
        return await self._get_all(
            models.ReconstructionSummary,
            "/api/v1/reconstructions",
            params={"device_id": device_id},
            limit=limit,
        )

    @ClientMethod
    async def create_reconstruction(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewReconstruction]
    ) -> models.Reconstruction:
        """Reconstruct points."""
        return await self._send(
            models.Reconstruction,
            "POST",
            "/api/v1/reconstructions",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def reconstruction(self, reconstruction_id: str) -> models.Reconstruction:
        """Read a reconstruction."""
        return await self._send(
            models.Reconstruction, "GET", path_of("/api/v1/reconstructions/{}", reconstruction_id)
        )

    @ClientMethod
    async def delete_reconstruction(self, reconstruction_id: str) -> None:
        """Delete a reconstruction."""
        await self._request("DELETE", path_of("/api/v1/reconstructions/{}", reconstruction_id))

    @ClientMethod
    async def start_recording(
        self,
        device_id: str,
        /,
        *,
        idempotency_key: str | None = None,
        **members: Unpack[bodies.RecordingsNewRecording],
    ) -> models.RecordingDetail:
        """Record a device."""
        return await self._send(
            models.RecordingDetail,
            "POST",
            path_of("/api/v1/devices/{}/recordings", device_id),
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def recordings(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.RecordingDocument]:
        """List recordings."""
        return await self._get_all(
            models.RecordingDocument,
            "/api/v1/recordings",
            params={"device_id": device_id},
            limit=limit,
        )

    @ClientMethod
    async def recording_retention(self) -> models.RetentionDocument:
        """How long recordings are kept."""
        return await self._send(models.RetentionDocument, "GET", "/api/v1/recording-retention")

    @ClientMethod
    async def stop_recording(self, recording_id: str) -> models.RecordingDetail:
        """End a recording."""
        return await self._send(
            models.RecordingDetail, "POST", path_of("/api/v1/recordings/{}/stop", recording_id)
        )

    @ClientMethod
    async def download_recording(self, recording_id: str, file: Path | str) -> Path:
        """Download a recording."""
        return await self._download(
            "GET", file, path_of("/api/v1/recordings/{}/file", recording_id)
        )

    @ClientMethod
    async def recorded_frames(
        self,
        recording_id: str,
        *,
        first: int | None = None,
        count: int | None = None,
        calibration_id: str | None = None,
        tracking: bool | None = None,
    ) -> models.RecordedFrames:
        """Look at frames of a recording."""
        return await self._send(
            models.RecordedFrames,
            "GET",
            path_of("/api/v1/recordings/{}/frames", recording_id),
            params={
                "first": first,
                "count": count,
                "calibration_id": calibration_id,
                "tracking": tracking,
            },
        )

    @ClientMethod
    async def recorded_scans(
        self, recording_id: str, *, number: int | None = None, detail_sensor: str | None = None
    ) -> models.DeviceScans:
        """Look at the scans of a recorded frame."""
        return await self._send(
            models.DeviceScans,
            "GET",
            path_of("/api/v1/recordings/{}/scans", recording_id),
            params={"number": number, "detail_sensor": detail_sensor},
        )

    @ClientMethod
    async def recording(self, recording_id: str) -> models.RecordingDetail:
        """Read about a recording."""
        return await self._send(
            models.RecordingDetail, "GET", path_of("/api/v1/recordings/{}", recording_id)
        )

    @ClientMethod
    async def delete_recording(self, recording_id: str) -> None:
        """Delete a recording."""
        await self._request("DELETE", path_of("/api/v1/recordings/{}", recording_id))

    @ClientMethod
    async def exports(self, *, limit: int | None = None) -> list[models.Export]:
        """List exports."""
        return await self._get_all(models.Export, "/api/v1/exports", limit=limit)

    @ClientMethod
    async def export(self, export_id: str) -> models.Export:
        """Read about an export."""
        return await self._send(models.Export, "GET", path_of("/api/v1/exports/{}", export_id))

    @ClientMethod
    async def delete_export(self, export_id: str) -> None:
        """Delete an export."""
        await self._request("DELETE", path_of("/api/v1/exports/{}", export_id))

    @ClientMethod
    async def download_export(self, export_id: str, file: Path | str) -> Path:
        """Download an export."""
        return await self._download("GET", file, path_of("/api/v1/exports/{}/file", export_id))

    @ClientMethod
    async def tools(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.Tool]:
        """List tools."""
        return await self._get_all(
            models.Tool, "/api/v1/tools", params={"device_id": device_id}, limit=limit
        )

    @ClientMethod
    async def create_tool(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewTool]
    ) -> models.Tool:
        """Create a tool of known geometry."""
        return await self._send(
            models.Tool,
            "POST",
            "/api/v1/tools",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def capture_tool(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewCapturedTool]
    ) -> models.Tool:
        """Define a tool by showing it."""
        return await self._send(
            models.Tool,
            "POST",
            "/api/v1/tool-captures",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def tool(self, tool_id: str) -> models.Tool:
        """Read a tool."""
        return await self._send(models.Tool, "GET", path_of("/api/v1/tools/{}", tool_id))

    @ClientMethod
    async def change_tool(
        self, tool_id: str, /, *, if_match: str | None = None, **members: Unpack[bodies.ToolChange]
    ) -> models.Tool:
        """Change a tool's title, tip, limits or reference."""
        return await self._send(
            models.Tool,
            "PATCH",
            path_of("/api/v1/tools/{}", tool_id),
            body=members,
            headers={"If-Match": if_match},
        )

    @ClientMethod
    async def delete_tool(self, tool_id: str, *, if_match: str | None = None) -> None:
        """Delete a tool."""
        await self._request(
            "DELETE", path_of("/api/v1/tools/{}", tool_id), headers={"If-Match": if_match}
        )

    @ClientMethod
    async def tool_pose(self, tool_id: str, *, frame_id: str | None = None) -> models.Pose:
        """Where a tool is now."""
        return await self._send(
            models.Pose,
            "GET",
            path_of("/api/v1/tools/{}/pose", tool_id),
            params={"frame_id": frame_id},
        )

    @ClientMethod
    async def calibrate_pivot(
        self,
        tool_id: str,
        /,
        *,
        idempotency_key: str | None = None,
        **members: Unpack[bodies.NewToolCalibration],
    ) -> models.ToolCalibration:
        """Find a tool's tip by pivoting it."""
        return await self._send(
            models.ToolCalibration,
            "POST",
            path_of("/api/v1/tools/{}/pivot-calibrations", tool_id),
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def calibrate_spin(
        self,
        tool_id: str,
        /,
        *,
        idempotency_key: str | None = None,
        **members: Unpack[bodies.NewToolCalibration],
    ) -> models.ToolCalibration:
        """Find a tool's long axis by spinning it."""
        return await self._send(
            models.ToolCalibration,
            "POST",
            path_of("/api/v1/tools/{}/spin-calibrations", tool_id),
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def tool_calibrations(
        self, tool_id: str, *, limit: int | None = None
    ) -> list[models.ToolCalibration]:
        """Pivot and spin calibrations of a tool."""
        return await self._get_all(
            models.ToolCalibration, path_of("/api/v1/tools/{}/calibrations", tool_id), limit=limit
        )

    @ClientMethod
    async def measure_point(
        self, tool_id: str, /, **members: Unpack[bodies.NewPoint]
    ) -> models.MeasuredPoint:
        """Measure a point with a tool's tip."""
        return await self._send(
            models.MeasuredPoint, "POST", path_of("/api/v1/tools/{}/points", tool_id), body=members
        )

    @ClientMethod
    async def registrations(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.Registration]:
        """List registrations."""
        return await self._get_all(
            models.Registration,
            "/api/v1/registrations",
            params={"device_id": device_id},
            limit=limit,
        )

    @ClientMethod
    async def create_registration(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewRegistration]
    ) -> models.Registration:
        """Register paired points, three markers, or a surface: a named frame."""
        return await self._send(
            models.Registration,
            "POST",
            "/api/v1/registrations",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
            extra_timeout_s=60.0,
        )

    @ClientMethod
    async def registration(self, registration_id: str) -> models.Registration:
        """Read a registration."""
        return await self._send(
            models.Registration, "GET", path_of("/api/v1/registrations/{}", registration_id)
        )

    @ClientMethod
    async def delete_registration(self, registration_id: str) -> None:
        """Delete a registration."""
        await self._request("DELETE", path_of("/api/v1/registrations/{}", registration_id))

    @ClientMethod
    async def frames(self, device_id: str) -> models.FrameList:
        """A device's frames, and what connects them now."""
        return await self._send(
            models.FrameList, "GET", path_of("/api/v1/devices/{}/frames", device_id)
        )

    @ClientMethod
    async def frame_transform(
        self, device_id: str, frame_id: str, *, to_frame_id: str | None = None
    ) -> models.FrameTransform:
        """The transform from one frame to another now."""
        return await self._send(
            models.FrameTransform,
            "GET",
            path_of("/api/v1/devices/{}/frames/{}", device_id, frame_id),
            params={"to_frame_id": to_frame_id},
        )

    @ClientMethod
    async def beam_holds(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.BeamHold]:
        """List beam holds."""
        return await self._get_all(
            models.BeamHold, "/api/v1/beam-holds", params={"device_id": device_id}, limit=limit
        )

    @ClientMethod
    async def create_beam_hold(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewBeamHold]
    ) -> models.BeamHold:
        """Create a beam hold."""
        return await self._send(
            models.BeamHold,
            "POST",
            "/api/v1/beam-holds",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def beam_hold(self, hold_id: str) -> models.BeamHold:
        """Read a beam hold."""
        return await self._send(models.BeamHold, "GET", path_of("/api/v1/beam-holds/{}", hold_id))

    @ClientMethod
    async def change_beam_hold(
        self,
        hold_id: str,
        /,
        *,
        if_match: str | None = None,
        **members: Unpack[bodies.BeamHoldChange],
    ) -> models.BeamHold:
        """Change a beam hold's limits, rules or title."""
        return await self._send(
            models.BeamHold,
            "PATCH",
            path_of("/api/v1/beam-holds/{}", hold_id),
            body=members,
            headers={"If-Match": if_match},
        )

    @ClientMethod
    async def delete_beam_hold(self, hold_id: str, *, if_match: str | None = None) -> None:
        """Delete a beam hold."""
        await self._request(
            "DELETE", path_of("/api/v1/beam-holds/{}", hold_id), headers={"If-Match": if_match}
        )

    @ClientMethod
    async def set_beam_hold_reference(
        self, hold_id: str, /, **members: Unpack[bodies.NewReference]
    ) -> models.BeamHold:
        """Say that all is where it is to be."""
        return await self._send(
            models.BeamHold,
            "POST",
            path_of("/api/v1/beam-holds/{}/reference", hold_id),
            body=members,
        )

    @ClientMethod
    async def remove_beam_hold_reference(self, hold_id: str) -> models.BeamHold:
        """Take a beam hold's reference away."""
        return await self._send(
            models.BeamHold, "DELETE", path_of("/api/v1/beam-holds/{}/reference", hold_id)
        )

    @ClientMethod
    async def acknowledge_beam_hold(self, hold_id: str) -> models.BeamHoldStatus:
        """Acknowledge a latched hold."""
        return await self._send(
            models.BeamHoldStatus, "POST", path_of("/api/v1/beam-holds/{}/acknowledge", hold_id)
        )

    @ClientMethod
    async def beam_hold_state(self, hold_id: str) -> models.BeamHoldStatus:
        """Whether the beam is held now."""
        return await self._send(
            models.BeamHoldStatus, "GET", path_of("/api/v1/beam-holds/{}/state", hold_id)
        )

    @ClientMethod
    async def find_peaks(self, **members: Unpack[bodies.LineScanRequest]) -> models.LineScans:
        """Find the peaks of scans."""
        return await self._send(models.LineScans, "POST", "/api/v1/line-scans", body=members)

    @ClientMethod
    async def draw_peaks(
        self,
        file: Path | str,
        *,
        scan: int | None = None,
        **members: Unpack[bodies.LineScanRequest],
    ) -> Path:
        """Draw a line and its peaks."""
        return await self._download(
            "POST", file, "/api/v1/line-scans.png", body=members, params={"scan": scan}
        )

    @ClientMethod
    async def device_scans(
        self,
        device_id: str,
        *,
        after: int | None = None,
        marker: int | None = None,
        detail_sensor: str | None = None,
    ) -> models.DeviceScans:
        """What the sensors of a device see now."""
        return await self._send(
            models.DeviceScans,
            "GET",
            path_of("/api/v1/devices/{}/scans", device_id),
            params={"after": after, "marker": marker, "detail_sensor": detail_sensor},
        )

    @ClientMethod
    async def device_profiles(
        self, *, limit: int | None = None
    ) -> list[models.DeviceProfileSummary]:
        """List device profiles."""
        return await self._get_all(
            models.DeviceProfileSummary, "/api/v1/device-profiles", limit=limit
        )

    @ClientMethod
    async def create_device_profile(
        self, *, idempotency_key: str | None = None, **members: Unpack[bodies.NewDeviceProfile]
    ) -> models.DeviceProfileDocument:
        """Keep a device profile."""
        return await self._send(
            models.DeviceProfileDocument,
            "POST",
            "/api/v1/device-profiles",
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def plan_profile(self, **members: Unpack[bodies.PlanRequest]) -> models.Plan:
        """Plan a device that is not kept."""
        return await self._send(models.Plan, "POST", "/api/v1/profile-plans", body=members)

    @ClientMethod
    async def device_profile(self, profile_id: str) -> models.DeviceProfileDocument:
        """Read a device profile."""
        return await self._send(
            models.DeviceProfileDocument, "GET", path_of("/api/v1/device-profiles/{}", profile_id)
        )

    @ClientMethod
    async def plan(self, profile_id: str, *, grid: int | None = None) -> models.Plan:
        """Plan a device."""
        return await self._send(
            models.Plan,
            "GET",
            path_of("/api/v1/device-profiles/{}/plan", profile_id),
            params={"grid": grid},
        )

    @ClientMethod
    async def plan_picture(
        self, profile_id: str, file: Path | str, *, grid: int | None = None
    ) -> Path:
        """Draw a plan."""
        return await self._download(
            "GET",
            file,
            path_of("/api/v1/device-profiles/{}/plan.png", profile_id),
            params={"grid": grid},
        )

    @ClientMethod
    async def stream_clients(self, *, limit: int | None = None) -> list[models.StreamClient]:
        """Who receives the streams, and who is slow."""
        return await self._get_all(models.StreamClient, "/api/v1/stream-clients", limit=limit)

    @ClientMethod
    async def keys(self, *, limit: int | None = None) -> list[models.ApiKey]:
        """List keys."""
        return await self._get_all(models.ApiKey, "/api/v1/keys", limit=limit)

    @ClientMethod
    async def create_key(self, **members: Unpack[bodies.NewApiKey]) -> models.CreatedApiKey:
        """Make a key."""
        return await self._send(models.CreatedApiKey, "POST", "/api/v1/keys", body=members)

    @ClientMethod
    async def key(self, key_id: str) -> models.ApiKey:
        """Read a key."""
        return await self._send(models.ApiKey, "GET", path_of("/api/v1/keys/{}", key_id))

    @ClientMethod
    async def revoke_key(self, key_id: str) -> models.ApiKey:
        """Revoke a key."""
        return await self._send(models.ApiKey, "POST", path_of("/api/v1/keys/{}/revoke", key_id))

    @ClientMethod
    async def principal(self) -> models.RequestPrincipal:
        """Who am I, and what may I do?."""
        return await self._send(models.RequestPrincipal, "GET", "/api/v1/principal")

    @ClientMethod
    async def webhooks(self, *, limit: int | None = None) -> list[models.Webhook]:
        """List webhooks."""
        return await self._get_all(models.Webhook, "/api/v1/webhooks", limit=limit)

    @ClientMethod
    async def create_webhook(self, **members: Unpack[bodies.NewWebhook]) -> models.CreatedWebhook:
        """Make a webhook."""
        return await self._send(models.CreatedWebhook, "POST", "/api/v1/webhooks", body=members)

    @ClientMethod
    async def webhook(self, webhook_id: str) -> models.Webhook:
        """Read a webhook."""
        return await self._send(models.Webhook, "GET", path_of("/api/v1/webhooks/{}", webhook_id))

    @ClientMethod
    async def change_webhook(
        self,
        webhook_id: str,
        /,
        *,
        if_match: str | None = None,
        **members: Unpack[bodies.WebhookChange],
    ) -> models.Webhook:
        """Change a webhook."""
        return await self._send(
            models.Webhook,
            "PATCH",
            path_of("/api/v1/webhooks/{}", webhook_id),
            body=members,
            headers={"If-Match": if_match},
        )

    @ClientMethod
    async def delete_webhook(self, webhook_id: str, *, if_match: str | None = None) -> None:
        """Delete a webhook."""
        await self._request(
            "DELETE", path_of("/api/v1/webhooks/{}", webhook_id), headers={"If-Match": if_match}
        )

    @ClientMethod
    async def webhook_state(self, webhook_id: str) -> models.WebhookState:
        """How deliveries go."""
        return await self._send(
            models.WebhookState, "GET", path_of("/api/v1/webhooks/{}/state", webhook_id)
        )

    @ClientMethod
    async def test_webhook(
        self, webhook_id: str, *, idempotency_key: str | None = None
    ) -> models.WebhookState:
        """Send a test event."""
        return await self._send(
            models.WebhookState,
            "POST",
            path_of("/api/v1/webhooks/{}/test", webhook_id),
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def audit(
        self,
        *,
        actor_id: str | None = None,
        operation: str | None = None,
        outcome: Literal["done", "refused"] | None = None,
        object_kind: str | None = None,
        object_id: str | None = None,
        since: datetime | None = None,
        until: datetime | None = None,
        limit: int | None = None,
    ) -> list[models.AuditEntry]:
        """Who changed what."""
        return await self._get_all(
            models.AuditEntry,
            "/api/v1/audit",
            params={
                "actor_id": actor_id,
                "operation": operation,
                "outcome": outcome,
                "object_kind": object_kind,
                "object_id": object_id,
                "since": since,
                "until": until,
            },
            limit=limit,
        )

    @ClientMethod
    async def log_records(
        self,
        *,
        level: Literal["debug", "info", "warning", "error", "critical"] | None = None,
        limit: int | None = None,
    ) -> list[models.LogRecord]:
        """The newest lines of the server's log."""
        return await self._get_all(
            models.LogRecord, "/api/v1/log-records", params={"level": level}, limit=limit
        )

    @ClientMethod
    async def settings(self, *, limit: int | None = None) -> list[models.Setting]:
        """The settings in force."""
        return await self._get_all(models.Setting, "/api/v1/settings", limit=limit)

    @ClientMethod
    async def stations(self, *, limit: int | None = None) -> list[models.Station]:
        """Stations and how they stand."""
        return await self._get_all(models.Station, "/api/v1/stations", limit=limit)

    @ClientMethod
    async def backups(self, *, limit: int | None = None) -> list[models.Backup]:
        """Backups of this server."""
        return await self._get_all(models.Backup, "/api/v1/backups", limit=limit)

    @ClientMethod
    async def metrics(self) -> str:
        """Figures for Prometheus."""
        return await self._text("GET", "/metrics")

    @ClientMethod
    async def create_quality_check(
        self,
        device_id: str,
        /,
        *,
        idempotency_key: str | None = None,
        **members: Unpack[bodies.NewQualityCheck],
    ) -> models.QualityCheck:
        """How well does a device measure now?."""
        return await self._send(
            models.QualityCheck,
            "POST",
            path_of("/api/v1/devices/{}/quality-checks", device_id),
            body=members,
            headers={"Idempotency-Key": idempotency_key},
        )

    @ClientMethod
    async def quality_checks(
        self,
        *,
        device_id: str | None = None,
        kind: Literal["single-point", "point-to-point"] | None = None,
        limit: int | None = None,
    ) -> list[models.QualityCheck]:
        """List quality checks."""
        return await self._get_all(
            models.QualityCheck,
            "/api/v1/quality-checks",
            params={"device_id": device_id, "kind": kind},
            limit=limit,
        )

    @ClientMethod
    async def quality_check(self, quality_check_id: str) -> models.QualityCheck:
        """Read a quality check."""
        return await self._send(
            models.QualityCheck, "GET", path_of("/api/v1/quality-checks/{}", quality_check_id)
        )

    @ClientMethod
    async def delete_quality_check(self, quality_check_id: str) -> None:
        """Delete a quality check."""
        await self._request("DELETE", path_of("/api/v1/quality-checks/{}", quality_check_id))

    @ClientMethod
    async def quality(self, device_id: str) -> models.Quality:
        """Is a device as good as it was?."""
        return await self._send(
            models.Quality, "GET", path_of("/api/v1/devices/{}/quality", device_id)
        )

    @ClientMethod
    async def quality_picture(self, device_id: str, file: Path | str) -> Path:
        """The control charts of a device."""
        return await self._download(
            "GET", file, path_of("/api/v1/devices/{}/quality.png", device_id)
        )

    @ClientMethod
    async def watch(self, device_id: str) -> models.WatchSettings:
        """How a device's drift is watched."""
        return await self._send(
            models.WatchSettings, "GET", path_of("/api/v1/devices/{}/watch", device_id)
        )

    @ClientMethod
    async def set_watch(
        self,
        device_id: str,
        /,
        *,
        if_match: str | None = None,
        **members: Unpack[bodies.WatchSettings],
    ) -> models.WatchSettings:
        """Say how a device's drift is watched."""
        return await self._send(
            models.WatchSettings,
            "PUT",
            path_of("/api/v1/devices/{}/watch", device_id),
            body=members,
            headers={"If-Match": if_match},
        )

    @ClientMethod
    async def watch_samples(
        self, *, device_id: str | None = None, limit: int | None = None
    ) -> list[models.WatchSample]:
        """List what the watch saw."""
        return await self._get_all(
            models.WatchSample,
            "/api/v1/watch-samples",
            params={"device_id": device_id},
            limit=limit,
        )

    @ClientMethod
    async def landing(self) -> models.Landing:
        """Where to go from here."""
        return await self._send(models.Landing, "GET", "/api/v1")

    @ClientMethod
    async def health(self) -> models.Health:
        """Is the process alive?."""
        return await self._send(models.Health, "GET", "/healthz")

    @ClientMethod
    async def readiness(self) -> models.Readiness:
        """Can requests be served?."""
        return await self._send(models.Readiness, "GET", "/readyz")

    @ClientMethod
    async def problems(self, *, limit: int | None = None) -> list[models.ProblemType]:
        """List all problem types."""
        return await self._get_all(models.ProblemType, "/problems", limit=limit)

    @ClientMethod
    async def problem(self, code: str) -> models.ProblemType:
        """What a problem type means."""
        return await self._send(models.ProblemType, "GET", path_of("/problems/{}", code))
