"""PackedLaunch beside Warp's own launch."""

import numpy as np
import warp as wp

from compute.warp_host import PackedLaunch, host_memory


@wp.kernel
def fill(out: wp.array(dtype=wp.float64), factor: wp.float64, first: int) -> None:  # type: ignore[valid-type]
    index = wp.tid()
    out[index] = factor * wp.float64(first + index)


def test_packed_launch_takes_changed_arguments_and_dimension() -> None:
    out = wp.zeros(5, dtype=wp.float64, device="cpu")
    recorded = wp.launch(
        fill, dim=5, inputs=[out, wp.float64(2.0), 1], device="cpu", record_cmd=True
    )
    packed = PackedLaunch(recorded)
    recorded.launch()
    by_warp = host_memory(out).copy()
    out.zero_()
    packed.run()
    np.testing.assert_array_equal(host_memory(out), by_warp)
    assert by_warp.tolist() == [2.0, 4.0, 6.0, 8.0, 10.0]
    packed.arguments.factor = 0.5
    packed.arguments.first = 10
    packed.set_dim(2)
    packed.run()
    assert host_memory(out).tolist() == [5.0, 5.5, 6.0, 8.0, 10.0]
