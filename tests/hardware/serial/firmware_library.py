"""The firmware's C files: compiled with the system's compiler, and called through ctypes."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from hardware.serial.messages import (
    Answer,
    Description,
    DeviceStatus,
    Lines,
)

FIRMWARE: Final = Path(__file__).parents[3] / "hardware" / "serial" / "firmware"
WARNINGS: Final = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")

SANITIZERS: Final = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def c_compiler() -> str | None:
    """Return the path of a C compiler, of the environment variable CC first; None: none."""
    names = (os.environ.get("CC", ""), "cc", "gcc", "clang")
    return next((found for name in names if name and (found := shutil.which(name))), None)


def compile_c(*arguments: str) -> None:
    """Compile; raises AssertionError with what the compiler says."""
    compiler = c_compiler()
    assert compiler is not None
    done = subprocess.run([compiler, *WARNINGS, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


def sanitizes(folder: Path) -> bool:
    """Return whether the compiler has SANITIZERS, and their library."""
    source = folder / "empty.c"
    source.write_text("int main(void) { return 0; }\n")
    compiler = c_compiler()
    assert compiler is not None
    command = [compiler, *SANITIZERS, str(source), "-o", str(folder / "empty")]
    return subprocess.run(command, capture_output=True).returncode == 0


WRITE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.POINTER(ctypes.c_uint8), ctypes.c_size_t)


class CEncoder(ctypes.Structure):
    _fields_ = (
        ("write", WRITE),
        ("context", ctypes.c_void_p),
        ("crc", ctypes.c_uint32),
        ("length", ctypes.c_uint8),
        ("after_full_block", ctypes.c_bool),
        ("block", ctypes.c_uint8 * 255),
    )


class CDescription(ctypes.Structure):
    _fields_ = (
        ("capabilities", ctypes.c_uint8),
        ("bits", ctypes.c_uint8),
        ("sensors", ctypes.c_uint8),
        ("markers", ctypes.c_uint8),
        ("pixels", ctypes.c_uint16),
        ("clock_bits", ctypes.c_uint8),
        ("clock_hz", ctypes.c_uint32),
        ("pitch_um", ctypes.c_float),
        ("electrons_per_count", ctypes.c_float),
        ("read_noise_electrons", ctypes.c_float),
        ("offset_counts", ctypes.c_float),
        ("frame_rate_hz", ctypes.c_float),
        ("exposure_us", ctypes.c_float),
        ("delay_us", ctypes.c_float),
        ("stripe_sigma_px", ctypes.c_float),
        ("name", ctypes.c_char_p),
        ("sensor_names", ctypes.POINTER(ctypes.c_char_p)),
    )


class CLines(ctypes.Structure):
    _fields_ = (
        ("marker", ctypes.c_uint8),
        ("flags", ctypes.c_uint8),
        ("sequence", ctypes.c_uint32),
        ("ticks", ctypes.c_uint64),
        ("lost", ctypes.c_uint32),
        ("first", ctypes.c_uint32),
    )


class CStatus(ctypes.Structure):
    _fields_ = (
        ("ticks", ctypes.c_uint64),
        ("temperature_c", ctypes.c_float),
        ("lost", ctypes.c_uint32),
        ("discarded", ctypes.c_uint32),
    )


class CCommand(ctypes.Structure):
    _fields_ = (
        ("type", ctypes.c_uint8),
        ("number", ctypes.c_uint16),
        ("frame_rate_hz", ctypes.c_float),
        ("exposure_us", ctypes.c_float),
        ("slot_count", ctypes.c_uint8),
        ("slots", ctypes.POINTER(ctypes.c_uint8)),
    )


class CReceiver(ctypes.Structure):
    _fields_ = (
        ("discarded", ctypes.c_uint32),
        ("length", ctypes.c_uint16),
        ("too_long", ctypes.c_bool),
        ("bytes", ctypes.c_uint8 * 272),
    )


class Firmware:
    """The compiled library; what it writes is returned."""

    def __init__(self, folder: Path) -> None:
        built = folder / "lumiline_serial.so"
        compile_c("-O1", "-shared", "-fPIC", str(FIRMWARE / "lumiline_serial.c"), "-o", str(built))
        self._library = ctypes.CDLL(str(built))
        self._library.lumiline_check_description.restype = ctypes.c_char_p
        self._library.lumiline_receive.restype = ctypes.c_bool
        self._written = bytearray()
        self._callback = WRITE(self._write)
        self._encoder = CEncoder()
        self._library.lumiline_encoder_init(ctypes.byref(self._encoder), self._callback, None)
        assert self._taken() == b"\0"

    def _write(self, context: int | None, data: "ctypes._Pointer[ctypes.c_uint8]", n: int) -> None:
        assert context is None
        self._written += ctypes.string_at(data, n)

    def _taken(self) -> bytes:
        written = bytes(self._written)
        self._written.clear()
        return written

    def _send(self, function: str, *arguments: object) -> bytes:
        getattr(self._library, function)(ctypes.byref(self._encoder), *arguments)
        return self._taken()

    def description(self, message: Description) -> bytes:
        return self._send("lumiline_send_description", ctypes.byref(c_description(message)))

    def check(self, message: Description) -> str | None:
        said = self._library.lumiline_check_description(ctypes.byref(c_description(message)))
        return None if said is None else said.decode()

    def lines(self, message: Lines, parts: Sequence[int] | None = None) -> bytes:
        """Encode at once, or with counts added in parts."""
        head = CLines(
            message.marker, int(message.flags), message.sequence, message.ticks, message.lost,
            message.first,
        )  # fmt: skip
        counts = np.ascontiguousarray(message.counts, np.uint16)

        def at(first: int, count: int) -> tuple[ctypes.c_void_p, ctypes.c_size_t]:
            return ctypes.c_void_p(counts.ctypes.data + 2 * first), ctypes.c_size_t(count)

        if parts is None:
            return self._send("lumiline_send_lines", ctypes.byref(head), *at(0, len(counts)))
        said = self._send("lumiline_begin_lines", ctypes.byref(head))
        cuts = [0, *sorted(parts), len(counts)]
        for first, end in pairwise(cuts):
            said += self._send("lumiline_add_counts", *at(first, end - first))
        return said + self._send("lumiline_end_lines")

    def status(self, message: DeviceStatus) -> bytes:
        of = CStatus(message.ticks, message.temperature_c, message.lost, message.garbled)
        return self._send("lumiline_send_status", ctypes.byref(of))

    def answer(self, message: Answer) -> bytes:
        command = CCommand(type=message.command, number=message.number)
        return self._send(
            "lumiline_send_answer", ctypes.byref(command), ctypes.c_uint8(message.result)
        )

    def received(self, data: bytes) -> tuple[list[tuple[object, ...]], int]:
        """Commands in received bytes as tuples, and how many messages were discarded."""
        receiver, command = CReceiver(), CCommand()
        commands: list[tuple[object, ...]] = []
        for byte in data:
            if self._library.lumiline_receive(
                ctypes.byref(receiver), ctypes.c_uint8(byte), ctypes.byref(command)
            ):
                slots = tuple(command.slots[: command.slot_count]) if command.slot_count else ()
                commands.append(
                    (command.type, command.number, command.frame_rate_hz, command.exposure_us,
                     slots)
                )  # fmt: skip
        return commands, receiver.discarded


def c_description(message: Description) -> CDescription:
    names = (ctypes.c_char_p * len(message.sensors))(*(name.encode() for name in message.sensors))
    return CDescription(
        int(message.abilities), message.bits, len(message.sensors), message.markers,
        message.pixels, message.clock_bits, message.clock_hz, message.pitch_um,
        message.electrons_per_count, message.read_noise_electrons, message.offset_counts,
        message.frame_rate_hz, message.exposure_us, message.delay_us, message.line_sigma_px,
        message.name.encode(), names,
    )  # fmt: skip
