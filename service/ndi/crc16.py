"""CRC-16 as the common API uses it: of x^16 + x^15 + x^2 + 1, reflected, begun with 0."""

from typing import Final


def _table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
        table.append(value)
    return tuple(table)


_TABLE: Final = _table()


def crc16(data: bytes) -> int:
    """Return the checksum (CRC-16/ARC) of these bytes."""
    crc = 0
    for byte in data:
        crc = (crc >> 8) ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc
