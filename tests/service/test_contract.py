"""The application keeps its OpenAPI contract under generated requests, with all checks on."""

import itertools
from collections.abc import Iterator
from typing import Any

import pytest
import schemathesis
from schemathesis.config import SchemathesisConfig

from service.app import create_app
from service.settings import Settings
from tests.service.recorded_live import RecordedLive, TestClient

SEED = 20031
EXAMPLES = 15

# What a JSON schema cannot say, and so is answered with 422 although the body fits it: that points
# are enough and span space, that names differ, that a sensor exists and a reading lies on its
# pixels, that a calibration is the device's, that a bar's plane has a normal, that lines are of
# one length, that points or a capture session are given, that bytes are a table. Everywhere else a
# request that fits the schema must be accepted, or find nothing (404) or a conflict (409).
RULES_BEYOND_THE_SCHEMA = {
    "create-calibration",
    "create-reconstruction",
    "create-device",
    "change-device",
    "find-peaks",
    "draw-peaks",
    "create-calibration-run",
    "create-mapping-run",
    "create-self-calibration-run",
    "create-capture",
    "upload-correction-table",
}


@schemathesis.serializer("application/x-hdf5")
def send_bytes(_context: Any, value: Any) -> bytes:
    """Send what is generated for a file; anything but bytes as the text that shows it."""
    return bytes(value) if isinstance(value, bytes | bytearray) else repr(value).encode()


class Relay:
    """Passes requests to whatever application there is; its lifespan is begun elsewhere."""

    def __init__(self) -> None:
        self.app = create_app(Settings())

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan":
            for answer in ("lifespan.startup.complete", "lifespan.shutdown.complete"):
                await receive()
                await send({"type": answer})
        else:
            await self.app(scope, receive, send)


relay = Relay()


def contract(accepted: list[str], *, every_value: bool = True) -> Any:
    """The schema, with the statuses that a request which fits it may be answered with."""
    config = {
        "seed": SEED,
        "generation": {"max-examples": EXAMPLES, "deterministic": True, "mode": "all"},
        "checks": {"positive_data_acceptance": {"expected-statuses": accepted}},
        "phases": {"coverage": {"enabled": every_value}},
    }
    return schemathesis.openapi.from_asgi(
        "/openapi.json", relay, config=SchemathesisConfig.from_dict(config)
    )


PLAIN = contract(["2xx", "404", "409"])
WITH_RULES = contract(["2xx", "404", "409", "422"])
# Its bodies are those of find-peaks, where every value of each setting is tried; a thousand
# pictures take minutes.
# Calibrations with all settings, and reports, take about a second each.
LONG = contract(["2xx", "404", "409", "422"], every_value=False)
DRAWN = contract(["2xx", "422"], every_value=False)


@pytest.fixture(scope="module", autouse=True)
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Run the application to which the schema's requests go."""
    data_dir = tmp_path_factory.mktemp("contract")
    # Hundreds of runs are posted, and all but a few wait until the server ends.
    settings = Settings(data_dir=data_dir, runs_waiting=1_000_000)
    relay.app = create_app(settings, RecordedLive())
    with TestClient(relay.app):
        yield


fresh = itertools.count()


def check_contract(case: Any) -> None:
    fits = case.meta.generation.mode.is_positive
    if fits and case.operation.definition.raw["operationId"].startswith("create-"):
        # Ids are examples, or drawn from few: most would be taken, and the rest not looked at.
        case.body["id"] = f"new-{next(fresh)}"
        case.body.pop("result_id", None)
    answer = case.call_and_validate()
    if fits and answer.status_code == 422:
        # A rule beyond the schema has a type of its own.
        assert answer.json()["type"] != "/problems/invalid-request", answer.text


def contract_test(operation_id: str) -> Any:
    schema = WITH_RULES if operation_id in RULES_BEYOND_THE_SCHEMA else PLAIN
    schema = LONG if operation_id in ("create-calibration", "get-calibration-report") else schema
    schema = DRAWN if operation_id == "draw-peaks" else schema

    @schema.include(operation_id=operation_id).parametrize()
    def test(case: Any) -> None:
        check_contract(case)

    return test


# One function for each operation: Schemathesis's own items all have the function's node id, by
# which pytest-xdist tells tests apart, and would run one operation only.
for path_item in relay.app.openapi()["paths"].values():
    for operation in path_item.values():
        name = operation["operationId"]
        globals()[f"test_{name.replace('-', '_')}"] = contract_test(name)
