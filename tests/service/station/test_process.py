"""The writer's end of the bus: in which order taps and batches come."""

import os
import threading
from types import SimpleNamespace
from typing import Any, cast

import pytest

from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION
from service.pipeline.frame_batch import FrameBatch
from service.station import process
from service.station.process import BusPublisher, BusTap
from service.station.shared_ring import Doorbell, RingReader, RingWriter, new_ring


def test_tap_that_wants_pixels_comes_before_a_batch_that_has_them_or_behind_one_that_has_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    memory, doorbell = new_ring(4096), Doorbell()
    reader = RingReader(memory)
    publisher = BusPublisher(RingWriter(memory), doorbell.write_descriptor)

    def attach() -> None:
        publisher.count_pixel_taps("sim", 1)
        BusTap(publisher, 1, wants_pixels=True).prepare(NO_ACTIVE_CALIBRATION)

    attaching = threading.Thread(target=attach)

    def batch_message(batch: FrameBatch, *, pixels: bool) -> bytes:
        attaching.start()
        attaching.join(0.5)  # what is right waits; what is wrong is attached by now
        return b"pixels" if pixels else b"none"

    monkeypatch.setattr(process, "batch_message", batch_message)
    monkeypatch.setattr(process, "calibration_message", lambda *_: b"calibration")
    publisher.publish_batch(cast("Any", SimpleNamespace(device_id="sim")))
    attaching.join()
    records = [record.data for record in reader.read(9)]
    os.close(memory)
    doorbell.close()
    assert records == [b"none", b"calibration"]
