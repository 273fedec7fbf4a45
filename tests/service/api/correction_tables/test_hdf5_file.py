"""Correction tables as HDF5: exact round trips; whatever else a file holds is refused."""

import io
import json
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from compute.errors import InvalidParameter, LumilineError, NonFiniteValue
from service.api.correction_tables import hdf5_file
from service.api.correction_tables.hdf5_file import read_table, write_table
from service.api.correction_tables.table_content import TableContent, check_table
from service.problems.errors import InvalidTableFile, NoValidCells
from tests.service.api.correction_tables.tables import content

HASH = "ab" * 32


@contextmanager
def changed(data: bytes) -> Iterator[tuple[h5py.File, list[bytes]]]:
    """A file to change; its bytes afterwards are in the list."""
    buffer, after = io.BytesIO(data), list[bytes]()
    with h5py.File(buffer, "r+") as file:
        yield file, after
    after.append(buffer.getvalue())


def assert_same(one: TableContent, other: TableContent) -> None:
    assert one.header() == other.header()
    for name in ("coefficients_px", "variance_px2", "valid"):
        np.testing.assert_array_equal(getattr(one.table, name), getattr(other.table, name))
    assert one.content_hash() == other.content_hash()


@pytest.mark.parametrize("degree", [1, 3])
def test_a_table_comes_back_bit_by_bit(degree: Any):
    given_content = content(HASH, degree=degree)
    assert_same(read_table(write_table(given_content)), given_content)


@given(
    values=arrays(np.float64, (1, 3, 2, 4), elements=st.floats(-1e5, 1e5)),
    text=st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=20),
)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_any_values_and_texts_come_back(values: Any, text: str):
    from compute.mapping.grid import VoxelGrid
    from compute.mapping.table import CorrectionTable

    grid = VoxelGrid((0.0, 0.0, 0.0), (1.0, 2.0, 3.0), (2, 1, 3))
    table = CorrectionTable(
        ("one",), HASH, grid, 1, values, np.zeros((1, 3, 2, 4)), np.ones((1, 2, 1, 3), np.bool_)
    )
    made = content(HASH)
    whole = TableContent(table, "sim", made.made_at, {text: text}, {"figure": [1, None, 2.5]})
    assert_same(read_table(write_table(whole)), whole)


def test_the_hash_is_of_everything():
    base = content(HASH)
    hashes = {base.content_hash()}
    coefficients = base.table.coefficients_px.copy()
    coefficients[0, 0, 0, 0] += 1e-12
    variance = base.table.variance_px2.copy()
    variance[0, 0, 0, 0] += 1e-12
    valid = base.table.valid.copy()
    valid[0, 0, 0, 0] = False
    others = [
        content("cd" * 32),
        content(HASH, coefficients_px=coefficients),
        content(HASH, variance_px2=variance),
        content(HASH, valid=valid),
        TableContent(base.table, "sim", base.made_at, {}, base.validation),
        TableContent(base.table, "sim", base.made_at, base.settings, {}),
        TableContent(base.table, "bar", base.made_at, base.settings, base.validation),
    ]
    hashes |= {other.content_hash() for other in others}
    assert len(hashes) == 1 + len(others)


def replace(file: h5py.File, name: str, **given: Any) -> None:
    del file[name]
    file.create_dataset(name, **given)


def set_attribute(name: str, value: Any) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file.attrs[name]
        if value is not None:
            file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value

    return change


def soft_link(file: h5py.File) -> None:
    del file["valid"]
    file["valid"] = h5py.SoftLink("/coefficients_px")


def external_link(file: h5py.File) -> None:
    del file["valid"]
    file["valid"] = h5py.ExternalLink("/etc/passwd", "/valid")


def external_data(file: h5py.File) -> None:
    shape = file["valid"].shape
    size = int(np.prod(shape))
    replace(file, "valid", shape=shape, dtype="|u1", external=[("/etc/passwd", 0, size)])


def virtual_data(file: h5py.File) -> None:
    shape = file["valid"].shape
    layout = h5py.VirtualLayout(shape, "|u1")
    layout[...] = h5py.VirtualSource("/etc/passwd", "valid", shape)
    del file["valid"]
    file.create_virtual_dataset("valid", layout)


def group(file: h5py.File) -> None:
    del file["valid"]
    file.create_group("valid")


def other_filter(file: h5py.File) -> None:
    replace(file, "valid", data=np.ones(file["valid"].shape, np.uint8), compression="lzf")


def huge(file: h5py.File) -> None:
    # Declares 64 TiB; not a byte of it is stored.
    replace(
        file, "coefficients_px", shape=(4, 2**12, 2**14, 2**17), dtype="<f8", compression="gzip",
        chunks=(1, 64, 64, 64),
    )  # fmt: skip


def growing(file: h5py.File) -> None:
    shape = file["valid"].shape
    values = np.ones(shape, np.uint8)
    replace(file, "valid", data=values, maxshape=(None, *shape[1:]), chunks=(1, *shape[1:]))


def bomb(file: h5py.File, mebibytes: int = 1024) -> None:
    """A chunk that declares a few hundred bytes and unpacks to a gigabyte."""
    shape = file["coefficients_px"].shape
    replace(
        file, "coefficients_px", shape=shape, dtype="<f8", compression="gzip",
        chunks=(1, *shape[1:]),
    )  # fmt: skip
    packer = zlib.compressobj(9)
    zeros = bytes(2**20)
    stored = b"".join(packer.compress(zeros) for _ in range(mebibytes)) + packer.flush()
    for sensor in range(shape[0]):
        file["coefficients_px"].id.write_direct_chunk((sensor, 0, 0, 0), stored)


def short_chunk(file: h5py.File) -> None:
    shape = file["valid"].shape
    replace(file, "valid", shape=shape, dtype="|u1", compression="gzip", chunks=(1, *shape[1:]))
    for sensor in range(shape[0]):
        file["valid"].id.write_direct_chunk((sensor, 0, 0, 0), zlib.compress(b"1234"))


def missing_chunk(file: h5py.File) -> None:
    shape = file["valid"].shape
    replace(file, "valid", shape=shape, dtype="|u1", compression="gzip", chunks=(1, *shape[1:]))


def never_written(file: h5py.File) -> None:
    replace(file, "valid", shape=file["valid"].shape, dtype="|u1")


def other_type(file: h5py.File) -> None:
    replace(file, "coefficients_px", data=np.zeros(file["coefficients_px"].shape, np.float32))


def other_values(file: h5py.File) -> None:
    file["coefficients_px"][0, 0, 0, 0] += 1.0


def two_as_truth(file: h5py.File) -> None:
    file["valid"][0, 0, 0, 0] = 2


def member(file: h5py.File) -> None:
    file["extra"] = np.zeros(3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_attribute("format", "another"), "format is"),
        (set_attribute("format", None), "no attribute format"),
        (set_attribute("format_version", 1), "format_version is 1"),
        (set_attribute("format_version", 2.0), "format_version has the type"),
        (set_attribute("cells", np.array([5, 4])), "cells has the type"),
        (set_attribute("cells", np.array([5.0, 4.0, 3.0])), "cells has the type"),
        (set_attribute("sensors", "one"), "sensors must list"),
        (set_attribute("sensors", ["x"] * 65), "sensors must list"),
        (set_attribute("sensors", ["x"] * 4), "sensors must list at most 64 names of fixed length"),
        (set_attribute("device", np.zeros(3)), "device must be one text"),
        (set_attribute("device", np.array("sim", h5py.string_dtype())), "one text of fixed length"),
        (set_attribute("made_at", "yesterday"), "made_at is"),
        (set_attribute("made_at", "2026-03-01T12:30:00"), "time zone"),
        (set_attribute("settings", "{"), "settings is not JSON"),
        (set_attribute("settings", '{"a": NaN}'), "NaN is not JSON"),
        (set_attribute("settings", '{"a": 1e999}'), "1e999 is beyond the largest number"),
        (set_attribute("settings", '{"a": [{"b": "\\ud800"}]}'), "settings is not JSON"),
        (set_attribute("validation", '{"\\udfff": 1}'), "validation is not JSON"),
        (set_attribute("settings", "[" * 100_000), "settings is not JSON"),
        (set_attribute("validation", "[1]"), "validation is JSON but no object"),
        (set_attribute("content_hash", "00" * 32), "changed after it was written"),
        (soft_link, "valid is a link"),
        (external_link, "valid is a link"),
        (external_data, "another file"),
        (virtual_data, "another file"),
        (group, "valid is a Group"),
        (other_filter, "filters"),
        (huge, "declares 35184372088832 values"),
        (growing, "fixed shape"),
        (bomb, "more memory than it says"),
        (short_chunk, "does not unpack"),
        (missing_chunk, "0 of its 4 chunks"),
        (never_written, "not written whole"),
        (other_type, "has the type float32"),
        (other_values, "changed after it was written"),
        (two_as_truth, "must be 0 or 1"),
        (member, 'member "extra"'),
        (lambda file: file.pop("valid"), "no dataset valid"),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)[:30]),
)
def test_what_is_no_table_is_refused(change: Callable[[h5py.File], Any], words: str):
    with changed(write_table(content(HASH))) as (file, after):
        change(file)
    with pytest.raises(InvalidTableFile) as error:
        read_table(after[0])
    assert words in error.value.detail


def test_what_is_not_hdf5_is_refused():
    for data in (b"", b"points", b"\x1f\x8b" + bytes(100), json.dumps({}).encode()):
        with pytest.raises(InvalidTableFile, match="not HDF5"):
            read_table(data)


def test_a_file_cut_short_anywhere_is_refused():
    data = write_table(content(HASH))
    for size in (*range(8, 200, 13), *range(200, len(data), 997), len(data) - 1):
        with pytest.raises(LumilineError):
            read_table(data[:size])


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_a_file_with_damaged_bytes_is_refused_or_the_same(seed: int):
    generator = np.random.default_rng(seed)
    whole = content(HASH)
    data = bytearray(write_table(whole))
    for place in generator.integers(8, len(data), 3):
        data[place] ^= int(generator.integers(1, 256))
    try:
        found = read_table(bytes(data))
    except LumilineError:
        return
    assert_same(found, whole)  # padding and the like


@pytest.mark.parametrize("place", range(48, 56))
def test_an_address_beyond_any_file_is_damage(place: int):
    data = bytearray(write_table(content(HASH)))
    data[place] = 0x80
    with pytest.raises(InvalidTableFile, match="damaged"):
        read_table(bytes(data))


def test_nan_and_wrong_shapes_are_named():
    with changed(write_table(content(HASH))) as (file, after):
        file["coefficients_px"][1, 2, 0, 0] = np.nan
    with pytest.raises(NonFiniteValue, match=r"coefficients_px\[1, 2, 0, 0\] is nan"):
        read_table(after[0])
    with changed(write_table(content(HASH))) as (file, after):
        replace(file, "variance_px2", data=np.zeros((4, 6, 5, 5)))
    with pytest.raises(InvalidParameter, match="variance_px2 has the shape"):
        read_table(after[0])


def test_a_reading_of_nothing_outside_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The refusals come before any data are read."""
    read: list[str] = []
    monkeypatch.setattr(hdf5_file, "_check_stored", lambda dataset, name: read.append(name))
    for change in (external_data, virtual_data, huge):
        with changed(write_table(content(HASH))) as (file, after):
            change(file)
        with pytest.raises(InvalidTableFile):
            read_table(after[0])
    assert set(read) <= {"coefficients_px", "variance_px2"}


def test_sensors_without_valid_cells_and_absurd_values_are_refused():
    valid = np.ones((4, 5, 4, 3), dtype=np.bool_)
    valid[2, 2, 1, 1] = False
    check_table(content(HASH, valid=valid).table)
    valid[2] = False
    with pytest.raises(NoValidCells, match="no cell of sensor diagonal-rising"):
        check_table(content(HASH, valid=valid).table)
    with pytest.raises(InvalidParameter, match="coefficients_px reaches 1e\\+06"):
        check_table(content(HASH, coefficients_px=np.full((4, 8, 7, 6), 1e6)).table)
