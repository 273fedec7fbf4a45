"""native_kernel: the Warp kernel that runs one native function on a record of arguments.

Only what launches kernels imports this module, when it is made: it loads Warp.
"""

from functools import cache
from typing import Any

import warp as wp

from compute.native.headers import module_options


@cache
def native_kernel(path: str, call: str) -> Any:
    """Return a kernel that takes the address of its record in the device's memory.

    Args:
        path: the header that has the function, from the root.
        call: the call in C++; ``number`` is that of the thread, ``address`` that of the record.
    """

    def native_call(number: int, address: wp.uint64) -> None: ...

    native = wp.func_native(call)(native_call)

    def run_native(address: wp.uint64) -> None:
        native(wp.tid(), address)

    return wp.kernel(module="unique", module_options=module_options(path))(run_native)
