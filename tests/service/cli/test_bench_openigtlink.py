"""The benchmark runs, and its figures mean what they say."""

import pytest

from benchmarks.openigtlink_clients import Received, figures
from service.cli.bench_openigtlink import RATE_HZ, TOOLS, measure


def test_figures_of_what_was_received():
    received = Received()
    for number, late in ((0, 0.001), (1, 0.001), (4, 0.003), (3, 0.001)):
        received.numbers["a"].append(number)
        received.sent_s["a"].append(0.005 * number)
        received.received_s["a"].append(0.005 * number + late)
    found = figures(received)
    assert found["messages"] == {"a": 4}
    assert (found["missed"], found["out_of_order"], found["first"]) == (2, 1, 0)
    assert abs(found["largest_gap_ms"] - 17.0) < 1e-9
    assert abs(found["latency_ms"]["p50"] - 1.0) < 1e-9
    assert abs(found["jitter_ms"]["max"] - 2.0) < 1e-9


@pytest.mark.slow
def test_a_short_run():
    found = measure(0.5, quiet=True)
    received, bare = found["received"], found["baseline"]
    assert found["frames_put_up"] == 0.5 * RATE_HZ
    assert set(received["messages"]) == set(bare["messages"])
    assert set(received["messages"]) == {f"{tool}ToTracker" for tool in TOOLS}
    # Of a busy machine nothing is said but that nothing came twice, damaged or in another order.
    assert 0 < max(received["messages"].values()) <= found["frames_put_up"]
    for one in (received, bare):
        assert (one["out_of_order"], one["wrong_checksums"]) == (0, 0)
    assert (received["stalls"], bare["stalls"]) == (1, 0)
