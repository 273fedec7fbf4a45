"""TableContent: a validated correction table with its provenance and content hash."""

import hashlib
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

import numpy as np

from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from service.api.calibrations.calibration_content import canonical_json
from service.problems.errors import InvalidTableFile, NoValidCells

MEDIA_TYPE: Final = "application/x-hdf5"
"""Of the files that tables are exchanged in; see ``service.api.correction_tables.hdf5_file``."""
_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
SIGNATURE_BYTES: Final = len(_SIGNATURE)
MAX_PX: Final = 1e5
"""Largest correction that means something: more than the pixels of any sensor."""
MAX_MM: Final = 1e6


@dataclass(frozen=True, eq=False)
class TableContent:
    """A correction table and its provenance; immutable, and what is hashed.

    Args:
        table: the table, with the hash of its parent calibration.
        device: the device's id.
        made_at: when it was computed, with its time zone.
        settings: how it was asked to be made, as a JSON object.
        validation: figures on measurements that it never saw, as a JSON object.
    """

    table: CorrectionTable
    device: str
    made_at: datetime
    settings: dict[str, Any]
    validation: dict[str, Any]

    def header(self) -> dict[str, Any]:
        """Return all but the arrays as a JSON object."""
        grid = self.table.grid
        return {
            "device": self.device,
            "sensors": list(self.table.sensors),
            "calibration_hash": self.table.calibration_hash,
            "grid": {
                "origin_mm": [float(value) for value in grid.origin_mm],
                "pitch_mm": [float(value) for value in grid.pitch_mm],
                "cells": [int(count) for count in grid.cells],
            },
            "degree": int(self.table.degree),
            "made_at": self.made_at.isoformat(),
            "settings": self.settings,
            "validation": self.validation,
        }

    def content_hash(self) -> str:
        """Return SHA-256 of the header's canonical JSON, a zero byte, and the arrays' bytes.

        The arrays follow as coefficients and variances in little-endian float64 and validity as
        bytes 0 and 1, each in C order.
        """
        digest = hashlib.sha256(canonical_json(self.header()))
        digest.update(b"\0")
        for values, kind in (
            (self.table.coefficients_px, "<f8"),
            (self.table.variance_px2, "<f8"),
            (self.table.valid, "u1"),
        ):
            digest.update(np.ascontiguousarray(values, dtype=kind).tobytes())
        return digest.hexdigest()


def check_table(table: CorrectionTable) -> None:
    """Check what shapes and finite numbers do not say: sizes that mean something, valid cells.

    Raises:
        InvalidParameter: a correction, variance or length beyond any sensor or room.
        NoValidCells: a sensor without any valid cell.
    """
    for name, most in (("coefficients_px", MAX_PX), ("variance_px2", MAX_PX**2)):
        largest = float(np.abs(getattr(table, name)).max())
        if largest > most:
            raise InvalidParameter(
                f"{name} reaches {largest:g}; it must be at most {most:g} in size",
                **{name: largest},
            )
    grid = table.grid
    corners = np.array([grid.origin_mm, grid.end_mm])
    if np.abs(corners).max() > MAX_MM:
        raise InvalidParameter(
            f"the grid reaches from {corners[0].tolist()} to {corners[1].tolist()} mm; it must lie "
            f"within {MAX_MM:g} mm of the origin"
        )
    for name, valid in zip(table.sensors, table.valid, strict=True):
        if not valid.any():
            raise NoValidCells(
                f"no cell of sensor {name} is valid; leave the sensor out of the device, or map it",
                sensor=name,
            )


def check_signature(data: bytes) -> None:
    """Raise InvalidTableFile when a file does not begin as HDF5 does."""
    if not data.startswith(_SIGNATURE):
        raise InvalidTableFile(
            f"the file is not HDF5: it begins with {data[:8]!r}; upload a file that was downloaded "
            "from /api/v1/correction-tables/{id}/file"
        )
