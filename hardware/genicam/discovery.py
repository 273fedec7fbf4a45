"""Discovery of the GenICam cameras that this host can reach."""

from dataclasses import dataclass

from hardware.genicam.aravis import library


@dataclass(frozen=True)
class DiscoveredCamera:
    """A discovered camera: identifier, address, vendor, model, serial number, protocol."""

    camera: str
    address: str
    vendor: str
    model: str
    serial_number: str
    protocol: str


def cameras() -> list[DiscoveredCamera]:
    """Return the cameras that answer within a second.

    Raises:
        MissingLibrary: Aravis is not installed.
    """
    aravis = library()
    aravis.update_device_list()
    asked = (
        aravis.get_device_id,
        aravis.get_device_address,
        aravis.get_device_vendor,
        aravis.get_device_model,
        aravis.get_device_serial_nbr,
        aravis.get_device_protocol,
    )
    return [
        DiscoveredCamera(*((ask(index) or b"").decode(errors="replace") for ask in asked))
        for index in range(aravis.get_n_devices())
    ]
