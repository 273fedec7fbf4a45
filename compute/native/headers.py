"""Reads the kernels' C++ headers and makes one source of a header and all that it includes.

Headers lie in the packages that use them, ``compute/**/native/*.h``. They include each other by
their paths from the root, ``#include "compute/native/platform.h"``. An included ``NAME.gen.h`` is
no file: it is what ``HEADER`` says in the Python module ``NAME`` of the same package, which holds
the constants and records that Python and C++ share (``compute.native.records``).
"""

import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module, resources
from typing import Any, Final

from compute.warp_host import suppress_greeting

GENERATED: Final = ".gen.h"
_INCLUDE: Final = re.compile(r'#include "(.*)"')
_ONCE: Final = "#pragma once"


@cache
def header_text(path: str) -> str:
    """Return the text of one header.

    Args:
        path: from the root, such as "compute/native/platform.h".

    Raises:
        FileNotFoundError: there is no such header.
    """
    if path.endswith(GENERATED):
        module = import_module(path.removesuffix(GENERATED).replace("/", "."))
        return str(module.HEADER)
    package, name = path.rsplit("/", 1)
    return resources.files(package.replace("/", ".")).joinpath(name).read_text(encoding="utf-8")


@cache
def combined_source(path: str, *, line_directives: bool = True) -> str:
    """Return a header's text with the text of all headers that it includes, each once.

    Args:
        path: the header, from the root.
        line_directives: compilers' messages name the headers and their lines.
    """
    lines = _lines(path, set())
    return "\n".join(line for line in lines if line_directives or not line.startswith("#line"))


def module_options(path: str, **options: Any) -> dict[str, Any]:
    """Return the options of a Warp module whose kernels call the functions of a header.

    Loads Warp.

    Args:
        path: the header, from the root.
        options: the module's other options.
    """
    import warp as wp

    suppress_greeting(wp)
    build = wp.ModuleBuildOptions(
        extra_cpu_preamble=combined_source(path),
        # NVRTC keeps no precompiled headers of a source with line directives.
        extra_cuda_preamble=combined_source(path, line_directives=False),
    )
    return {"enable_backward": False, "fast_math": False, "extra_build_options": build, **options}


def _lines(path: str, included: set[str]) -> Iterator[str]:
    if path in included:
        return
    included.add(path)
    yield f'#line 1 "{path}"'
    for number, line in enumerate(header_text(path).splitlines(), 1):
        include = _INCLUDE.fullmatch(line)
        if include:
            yield from _lines(include[1], included)
            yield f'#line {number + 1} "{path}"'
        elif line != _ONCE:
            yield line
