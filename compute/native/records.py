"""Structures and constants that Python and C++ share: written once, here in Python."""

import re
from collections.abc import Mapping
from typing import Final

import numpy as np

_TYPES: Final = {
    "double": "<f8",
    "float": "<f4",
    "int": "<i4",
    "long long": "<i8",
    "unsigned long long": "<u8",
}
_ARRAY: Final = re.compile(r"(.*?)((?:\[\d+\])*)")


class Record:
    """A structure's layout, for NumPy and for C++.

    Attributes:
        name: the structure's name in C++.
        dtype: the same as NumPy's type, aligned as C++ aligns it. A pointer is a ``uint64``.
        source: the structure in C++, with an assertion of its size.

    Args:
        name: the structure's name in C++.
        fields: the C++ type of each field: "double", "int", "const double*", "double[3]", or the
            Record of a structure within this one.
    """

    def __init__(self, name: str, fields: Mapping[str, "str | Record"]) -> None:
        self.name = name
        self.dtype: np.dtype[np.void] = np.dtype(
            [(field, *_numpy_type(kind)) for field, kind in fields.items()], align=True
        )
        lines = "".join(f"  {_declared(field, kind)};\n" for field, kind in fields.items())
        self.source = (
            f"struct {name} {{\n{lines}}};\n"
            f'static_assert(sizeof({name}) == {self.dtype.itemsize}, "{name} as in Python");\n'
        )


def constants(values: Mapping[str, int | float]) -> str:
    """Return definitions of constants in C++, floats to the last digit."""
    return "".join(
        f"constexpr {'double' if isinstance(value, float) else 'int'} {name} = "
        f"{repr(float(value)) if isinstance(value, float) else int(value)};\n"
        for name, value in values.items()
    )


def header(namespace: str, *parts: str, includes: tuple[str, ...] = ()) -> str:
    """Return a header of these definitions.

    Args:
        namespace: the C++ namespace that they are in.
        parts: from ``constants`` and ``Record.source``.
        includes: headers that they need.
    """
    needed = "".join(f'#include "{path}"\n' for path in includes)
    body = "\n".join(parts)
    return f"{needed}namespace {namespace} {{\n\n{body}\n}}  // namespace {namespace}\n"


def _numpy_type(kind: str | Record) -> tuple[object, ...]:
    if isinstance(kind, Record):
        return (kind.dtype,)
    base, sizes = _parts(kind)
    if base.endswith("*"):
        return ("<u8",)
    shape = tuple(int(size) for size in re.findall(r"\d+", sizes))
    return (_TYPES[base], shape) if shape else (_TYPES[base],)


def _declared(field: str, kind: str | Record) -> str:
    if isinstance(kind, Record):
        return f"{kind.name} {field}"
    base, sizes = _parts(kind)
    return f"{base} {field}{sizes}"


def _parts(kind: str) -> tuple[str, str]:
    match = _ARRAY.fullmatch(kind)
    assert match is not None
    return match[1], match[2]
