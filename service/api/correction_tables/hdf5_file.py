"""Correction tables as HDF5 files; what is read is validated as untrusted input."""

import io
import json
import math
import zlib
from datetime import datetime
from typing import Any, Final, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from compute.damaged_file import refusing_damage
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable, Degree
from service.api.correction_tables.table_content import TableContent, check_signature
from service.problems.errors import InvalidTableFile

FORMAT: Final = "lumiline-correction-table"
VERSION: Final = 2

_ARRAYS: Final = {"coefficients_px": "<f8", "variance_px2": "<f8", "valid": "|u1"}
_TEXTS: Final = (
    "format",
    "device",
    "calibration_hash",
    "made_at",
    "settings",
    "validation",
    "content_hash",
)
_NUMBERS: Final = {
    "format_version": ("iu", ()),
    "degree": ("iu", ()),
    "origin_mm": ("f", (3,)),
    "pitch_mm": ("f", (3,)),
    "cells": ("iu", (3,)),
}
_MAX_SENSORS: Final = 64
_MAX_VALUES: Final = 2**24
"""Largest number of values in one array, 128 MiB."""
_MAX_TEXT: Final = 2**18
_DEFLATE, _SHUFFLE = h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE


def write_table(content: TableContent) -> bytes:
    """Return a table with its provenance as an HDF5 file.

    Root attributes: format, format_version, device, sensors, calibration_hash, degree, origin_mm,
    pitch_mm, cells, made_at (ISO 8601), settings and validation (JSON), content_hash. Datasets:
    coefficients_px, variance_px2 (float64), valid (0 and 1), with the shapes of CorrectionTable.
    Texts are UTF-8 of fixed length: a damaged length of another one makes HDF5 loop for ever.
    """
    table, grid = content.table, content.table.grid
    buffer = io.BytesIO()
    texts = {
        "format": FORMAT,
        "device": content.device,
        "calibration_hash": table.calibration_hash,
        "made_at": content.made_at.isoformat(),
        "settings": json.dumps(content.settings, allow_nan=False),
        "validation": json.dumps(content.validation, allow_nan=False),
        "content_hash": content.content_hash(),
    }
    # The latest layout has checksums of all metadata, and takes texts beyond 64 KiB.
    with h5py.File(buffer, "w", libver="latest") as file:
        for name, text in texts.items():
            file.attrs[name] = _fixed(text)[0]
        file.attrs["format_version"] = VERSION
        file.attrs["sensors"] = _fixed(*table.sensors)
        file.attrs["degree"] = int(table.degree)
        file.attrs["origin_mm"] = np.array(grid.origin_mm, dtype=np.float64)
        file.attrs["pitch_mm"] = np.array(grid.pitch_mm, dtype=np.float64)
        file.attrs["cells"] = np.array(grid.cells, dtype=np.int64)
        for name, kind in _ARRAYS.items():
            values = np.ascontiguousarray(getattr(table, name), dtype=kind)
            file.create_dataset(
                name, data=values, chunks=(1, *values.shape[1:]), compression="gzip", shuffle=True
            )
    return buffer.getvalue()


def _fixed(*texts: str) -> NDArray[np.bytes_]:
    """Return texts as HDF5 strings of fixed length."""
    encoded = [text.encode() for text in texts]
    return np.array(encoded, dtype=f"S{max(1, *map(len, encoded))}")


def read_table(data: bytes) -> TableContent:
    """Return what a file holds, which may come from anybody; nothing is read before it is sized.

    Raises:
        InvalidTableFile: not HDF5, cut short, of another format, or with anything that a table
            has no use for: links, external or virtual data, other filters, data that grow beyond
            their declared size, unknown members.
        InvalidParameter, NonFiniteValue: shapes or values that make no table.
    """
    check_signature(data)
    with (
        refusing_damage(
            lambda reason: InvalidTableFile(
                f"the file is HDF5 but is cut short or damaged: {reason}"
            )
        ),
        h5py.File(io.BytesIO(data), "r") as file,
    ):
        return _read(file)


def _read(file: h5py.File) -> TableContent:
    texts, numbers, sensors = _attributes(file)
    grid = VoxelGrid(
        _three(numbers["origin_mm"], float),
        _three(numbers["pitch_mm"], float),
        _three(numbers["cells"], int),
    )
    others = set(file) - set(_ARRAYS)
    if others:
        raise InvalidTableFile(
            f'the file has a member "{min(others)[:100]}", which is no part of a table; it must '
            f"have {', '.join(_ARRAYS)} and nothing else"
        )
    arrays = {name: _array(file, name, kind) for name, kind in _ARRAYS.items()}
    if (arrays["valid"] > 1).any():
        raise InvalidTableFile(f"valid holds {arrays['valid'].max()}; it must be 0 or 1")
    table = CorrectionTable(
        sensors,
        texts["calibration_hash"],
        grid,
        cast("Degree", int(numbers["degree"])),  # the table checks it
        arrays["coefficients_px"],
        arrays["variance_px2"],
        arrays["valid"].astype(np.bool_),
    )
    content = TableContent(
        table,
        texts["device"],
        _moment(texts["made_at"]),
        _object("settings", texts["settings"]),
        _object("validation", texts["validation"]),
    )
    if content.content_hash() != texts["content_hash"]:
        raise InvalidTableFile(
            f"the file's content_hash is {texts['content_hash'][:64]}, its content has "
            f"{content.content_hash()}; it was changed after it was written"
        )
    return content


def _attributes(
    file: h5py.File,
) -> tuple[dict[str, str], dict[str, NDArray[Any]], tuple[str, ...]]:
    """Return the texts, the numbers and the sensors' names."""
    texts = {"format": _text(file, "format")}
    if texts["format"] != FORMAT:
        raise InvalidTableFile(
            f'the file\'s format is "{texts["format"][:100]}"; it must be {FORMAT}'
        )
    numbers = {"format_version": _number(file, "format_version")}
    if int(numbers["format_version"]) != VERSION:
        raise InvalidTableFile(
            f"the file's format_version is {int(numbers['format_version'])}; this server reads "
            f"version {VERSION}"
        )
    texts |= {name: _text(file, name) for name in _TEXTS}
    numbers |= {name: _number(file, name) for name in _NUMBERS}
    attribute = _attribute(file, "sensors")
    if not _is_text(attribute) or len(attribute.shape) != 1 or attribute.shape[0] > _MAX_SENSORS:
        raise InvalidTableFile(
            f"the attribute sensors must list at most {_MAX_SENSORS} names of fixed length; "
            f"it has the type {attribute.dtype} and the shape {attribute.shape}"
        )
    return texts, numbers, tuple(_decoded("sensors", name) for name in file.attrs["sensors"])


def _attribute(file: h5py.File, name: str) -> h5py.h5a.AttrID:
    if name not in file.attrs:
        raise InvalidTableFile(f"the file has no attribute {name}")
    return file.attrs.get_id(name)


def _is_text(attribute: h5py.h5a.AttrID) -> bool:
    """Whether it is a text of fixed length: reading a damaged other one may not end."""
    kind = h5py.check_string_dtype(attribute.dtype)
    return kind is not None and kind.length is not None


def _text(file: h5py.File, name: str) -> str:
    attribute = _attribute(file, name)
    if not _is_text(attribute) or attribute.shape != ():
        raise InvalidTableFile(
            f"the attribute {name} must be one text of fixed length; it has the type "
            f"{attribute.dtype} and the shape {attribute.shape}"
        )
    return _decoded(name, file.attrs[name])


def _decoded(name: str, value: Any) -> str:
    try:
        text = value.decode() if isinstance(value, bytes) else str(value)
        text.encode()
    except UnicodeError as error:
        raise InvalidTableFile(f"the attribute {name} is not UTF-8") from error
    if len(text) > _MAX_TEXT or "\0" in text:
        raise InvalidTableFile(
            f"the attribute {name} has {len(text)} characters or a zero among them; it must have "
            f"at most {_MAX_TEXT}, and none"
        )
    return text


def _number(file: h5py.File, name: str) -> NDArray[Any]:
    kinds, shape = _NUMBERS[name]
    attribute = _attribute(file, name)
    if attribute.dtype.kind not in kinds or attribute.shape != shape:
        raise InvalidTableFile(
            f"the attribute {name} has the type {attribute.dtype} and the shape {attribute.shape}; "
            f"it must be {'whole numbers' if kinds == 'iu' else 'numbers'} of the shape {shape}"
        )
    value: NDArray[Any] = np.asarray(file.attrs[name])
    return value


def _array(file: h5py.File, name: str, kind: str) -> NDArray[Any]:
    """Return a dataset's content after its declared and stored sizes were checked."""
    link = file.get(name, getlink=True)
    if link is None:
        raise InvalidTableFile(f"the file has no dataset {name}")
    if not isinstance(link, h5py.HardLink):
        raise InvalidTableFile(f"{name} is a link to elsewhere; it must be a dataset of the file")
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise InvalidTableFile(f"{name} is a {type(found).__name__}; it must be a dataset")
    if found.is_virtual or found.external is not None:
        raise InvalidTableFile(f"{name} keeps its data in another file; it must hold them itself")
    if found.dtype != np.dtype(kind) or found.ndim != 4:
        raise InvalidTableFile(
            f"{name} has the type {found.dtype} and {found.ndim} dimensions; it must have the type "
            f"{np.dtype(kind)} and 4"
        )
    if found.size > _MAX_VALUES or found.maxshape != found.shape:
        raise InvalidTableFile(
            f"{name} declares {found.size} values (shape {found.shape}); it must have at most "
            f"{_MAX_VALUES}, of a fixed shape"
        )
    _check_stored(found, name)
    values: NDArray[Any] = found[()]
    return values


def _check_stored(dataset: h5py.Dataset, name: str) -> None:
    """Check that the stored chunks exist and unpack to no more than the declared size."""
    filters = dataset.id.get_create_plist()
    known = [filters.get_filter(index)[0] for index in range(filters.get_nfilters())]
    if known not in ([], [_DEFLATE], [_SHUFFLE], [_SHUFFLE, _DEFLATE]):
        raise InvalidTableFile(
            f"{name} is stored with the filters {known}; gzip and shuffle are possible, no others"
        )
    if dataset.chunks is None:
        if dataset.size and dataset.id.get_storage_size() != dataset.nbytes:
            raise InvalidTableFile(
                f"{name} declares {dataset.nbytes} bytes and stores "
                f"{dataset.id.get_storage_size()}; it was not written whole"
            )
        return
    chunk_bytes = int(np.prod(dataset.chunks, dtype=object)) * dataset.dtype.itemsize
    if chunk_bytes > _MAX_VALUES * 8:
        raise InvalidTableFile(f"{name} has chunks of {chunk_bytes} bytes, more than a whole table")
    sizes = zip(dataset.shape, dataset.chunks, strict=True)
    expected = math.prod(-(-size // step) for size, step in sizes)
    if dataset.id.get_num_chunks() != expected:
        raise InvalidTableFile(
            f"{name} has {dataset.id.get_num_chunks()} of its {expected} chunks; it was not "
            "written whole"
        )
    for index in range(expected):
        place = dataset.id.get_chunk_info(index).chunk_offset
        mask, stored = dataset.id.read_direct_chunk(place)
        packed = _DEFLATE in known and not mask & (1 << known.index(_DEFLATE))
        if (_unpacked(stored, chunk_bytes) if packed else len(stored)) != chunk_bytes:
            raise InvalidTableFile(
                f"a chunk of {name} does not unpack to its {chunk_bytes} bytes; the file is "
                "damaged, or made to take more memory than it says"
            )


def _unpacked(stored: bytes, most: int) -> int:
    """Return how many bytes a chunk unpacks to; ``most + 1`` for any more than ``most``."""
    unpacker = zlib.decompressobj()
    try:
        found = len(unpacker.decompress(stored, most + 1))
    except zlib.error:
        return -1
    return found if unpacker.eof or found > most else -1


def _three(values: NDArray[Any], kind: type) -> Any:
    return tuple(kind(value) for value in values)


def _moment(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        raise InvalidTableFile(
            f'made_at is "{text[:100]}"; it must be a moment with its time zone (ISO 8601)'
        )
    return moment


def _object(name: str, text: str) -> dict[str, Any]:
    """Return a JSON object without NaN; nested too deeply it is refused by the parser."""

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not JSON")

    def finite(digits: str) -> float:
        value = float(digits)
        if not math.isfinite(value):
            raise ValueError(f"{digits[:40]} is beyond the largest number")
        return value

    try:
        found = json.loads(text, parse_constant=refuse, parse_float=finite)
        # An escaped half of a surrogate pair parses, but is no text that can be hashed or stored.
        json.dumps(found, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise InvalidTableFile(f"{name} is not JSON: {_first_line(error)}") from error
    if not isinstance(found, dict):
        raise InvalidTableFile(f"{name} is JSON but no object")
    return found


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
