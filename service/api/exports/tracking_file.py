"""What a device follows, and how, from a JSON file: as REST sends the device."""

import json
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ValidationError

from compute.errors import InvalidParameter
from service.api.base_models import Slug
from service.api.devices.tracking_settings import Tracking


class _Device(BaseModel):
    id: Slug
    tracking: Tracking


@dataclass(frozen=True)
class DeviceTracking:
    """A device as far as tracking goes.

    Args:
        id: its id.
        tracking: how its markers and tools are followed.
    """

    id: str
    tracking: Tracking


def read_device(path: Path) -> DeviceTracking:
    """Return what the answer of ``GET /api/v1/devices/{id}`` in a file says of tracking.

    Raises:
        InvalidParameter: the file cannot be read, or holds no device.
    """
    try:
        found = _Device.model_validate(json.loads(path.read_bytes()))
    except OSError as error:
        raise InvalidParameter(f"{path} cannot be read: {error.strerror or error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the whole"
        raise InvalidParameter(
            f"{path} holds no device: {place}: {first['msg']}; it must be the answer of "
            "GET /api/v1/devices/{id}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InvalidParameter(f"{path} is not JSON: {error}") from error
    return DeviceTracking(found.id, found.tracking)
