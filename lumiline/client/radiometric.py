"""Requests about radiometric calibrations of a device's sensors, and their captures."""

from collections.abc import Mapping
from typing import Any, Final

from lumiline.client.exchange import ClientMethod, Exchanges
from lumiline.client.models import RadiometricCalibration, RadiometricCapture

CAPTURE_TIMEOUT_S: Final = 120.0
"""How long the server waits for the frames of a capture, at most [s]."""


class RadiometricMethods(Exchanges):
    """Requests about radiometric calibrations of a device's sensors, and their captures."""

    @ClientMethod
    async def radiometric_calibrations(
        self, device_id: str | None = None
    ) -> list[RadiometricCalibration]:
        """Radiometric calibrations, newest first; of one device."""
        return await self._get_all(
            RadiometricCalibration, "radiometric-calibrations", device=device_id
        )

    @ClientMethod
    async def radiometric_calibration(self, radiometric_id: str) -> RadiometricCalibration:
        """One radiometric calibration, with the numbers of its pixels in ``content``."""
        return await self._get(RadiometricCalibration, "radiometric-calibrations", radiometric_id)

    @ClientMethod
    async def create_radiometric_calibration(
        self,
        device_id: str,
        source: Mapping[str, Any],
        *,
        radiometric_id: str | None = None,
        note: str = "",
    ) -> RadiometricCalibration:
        """Estimate and store a radiometric calibration; it is not activated.

        Args:
            device_id: the device.
            source: what it is estimated from, as the server's interface has it: captures,
                recordings, scans, or a document that was estimated elsewhere.
            radiometric_id: its id; None: the server's choice.
            note: for people.
        """
        body = {"id": radiometric_id, "device": device_id, "source": dict(source), "note": note}
        return await self._send(
            RadiometricCalibration, "POST", "radiometric-calibrations", body=body
        )

    @ClientMethod
    async def activate_radiometric_calibration(
        self, radiometric_id: str, expected: str | None = None
    ) -> RadiometricCalibration:
        """Find peaks with it; only if ``expected`` is active, where it is given."""
        path = ("radiometric-calibrations", radiometric_id, "activate")
        return await self._send(RadiometricCalibration, "POST", *path, expected=expected)

    @ClientMethod
    async def deactivate_radiometric_calibration(
        self, radiometric_id: str
    ) -> RadiometricCalibration:
        """Let its device go on without it."""
        path = ("radiometric-calibrations", radiometric_id, "deactivate")
        return await self._send(RadiometricCalibration, "POST", *path)

    @ClientMethod
    async def begin_radiometric_capture(
        self, device_id: str, *, frames: int = 128, levels: int = 6
    ) -> RadiometricCapture:
        """Begin a session of dark and flat captures; ``instruction`` says what to do.

        Args:
            device_id: the device.
            frames: of each capture.
            levels: flat captures, of different amounts of light.
        """
        body = {"device": device_id, "settings": {"frames": frames, "levels": levels}}
        return await self._send(RadiometricCapture, "POST", "radiometric-captures", body=body)

    @ClientMethod
    async def capture_radiometric_frames(
        self,
        capture_id: str,
        kind: str | None = None,
        *,
        temperature_c: float | None = None,
        relative_light: float | None = None,
    ) -> RadiometricCapture:
        """Capture the next frames of the running device.

        Args:
            capture_id: the session.
            kind: ``dark`` or ``flat``; None: what is next.
            temperature_c: of the sensors [°C].
            relative_light: light of this level, in any unit.
        """
        return await self._send(
            RadiometricCapture,
            "POST",
            "radiometric-captures",
            capture_id,
            "capture",
            extra_timeout_s=CAPTURE_TIMEOUT_S,
            kind=kind,
            temperature_c=temperature_c,
            relative_light=relative_light,
        )
