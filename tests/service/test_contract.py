"""The application keeps its OpenAPI contract under generated requests, with all checks on."""

import itertools
import json
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
import schemathesis
from schemathesis.config import SchemathesisConfig
from schemathesis.core.parameters import ParameterLocation
from schemathesis.generation.meta import TestPhase
from schemathesis.specs.openapi.checks import (
    allow_header_conformance,
    positive_data_acceptance,
    unsupported_method,
)

from hardware.errors import DeviceNotConnected
from hardware.genicam.driver import GenicamDriver
from hardware.serial.driver import SerialDriver
from hardware.tcd1304.driver import Tcd1304Driver
from service.application.app import create_app
from service.principal import SCOPES
from service.security.store import add_key
from service.settings import Settings
from tests.openapi_document import openapi_document
from tests.service.fake_pipeline import FakePipeline, TestClient

pytestmark = pytest.mark.slow

SEED = 20031
# The same in every run, beside the cases made of every value: more find little more.
EXAMPLES = 8

# What a JSON schema cannot say, and so is answered with 422 although the body fits it: that
# points are enough and span space, that names differ, that a sensor exists and a reading lies on
# its pixels, that a calibration is the device's, that a bar's plane has a normal, that lines are
# of one length, that markers make a tool that is like no other, that points or a capture session
# are given, that bytes are a table, that a text is a profile, that a URL leads to a receiver.
# Everywhere else a request that fits the schema must be accepted, or find nothing (404) or a
# conflict (409).
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
    "create-update-run",
    "create-export-run",
    "create-drift-check",
    "create-capture",
    "create-radiometric-calibration",
    "create-wave-capture",
    "upload-correction-table",
    "create-key",
    "create-quality-check",
    "create-tool",
    "capture-tool",
    "change-tool",
    "create-registration",
    "create-beam-hold",
    "change-beam-hold",
    "set-beam-hold-reference",
    "create-webhook",
    "change-webhook",
    "create-device-profile",
    "plan-profile",
}
WITHOUT_ID = {"create-key", "create-device-profile"}
# Ids of recordings may have a slash: another method may find a recording of that name. Under /runs
# the kinds, by which runs are posted, have the paths of runs of these ids.
ANOTHER_METHOD_MAY_BE = {
    "get-recorded-frames",
    "get-recorded-scans",
    "create-calibration-run",
    "create-self-calibration-run",
    "create-mapping-run",
    "create-update-run",
    "create-export-run",
}


@schemathesis.serializer("application/x-hdf5")
def send_bytes(_context: Any, value: Any) -> bytes:
    """Send what is generated for a file; anything but bytes as the text that shows it."""
    return bytes(value) if isinstance(value, bytes | bytearray) else repr(value).encode()


class Relay:
    """Passes requests to whatever application there is; its lifespan is begun elsewhere."""

    def __init__(self) -> None:
        self.app = create_app(Settings())
        self.key = ""

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan":
            for answer in ("lifespan.startup.complete", "lifespan.shutdown.complete"):
                await receive()
                await send({"type": answer})
        else:
            await self.app(scope, receive, send)


relay = Relay()


def shorter(schema: Any) -> Any:
    """The same schema, with tuples of one kind as lists of that length.

    Of a tuple every item is tried with every wrong value, of a list one: in a covariance of 6 by 6
    that is the same said 36 times, at as many requests each.
    """
    if isinstance(schema, list):
        return [shorter(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    schema = {key: shorter(value) for key, value in schema.items()}
    items = schema.get("prefixItems")
    length = {schema.get("minItems"), schema.get("maxItems")}
    if isinstance(items, list) and length == {len(items)} and items == items[:1] * len(items):
        schema["items"] = schema.pop("prefixItems")[0]
    return schema


def without_cursors(document: Any) -> Any:
    """The same document, without the cursors of lists: no text but the server's own is one."""
    for item in document["paths"].values():
        for operation in item.values():
            parameters = operation.get("parameters", [])
            operation["parameters"] = [one for one in parameters if one["name"] != "cursor"]
    return document


DOCUMENT = without_cursors(shorter(json.loads(json.dumps(openapi_document()))))


def contract(accepted: list[str], *, every_value: bool = True) -> Any:
    """The schema, with the statuses that a request which fits it may be answered with."""
    config = {
        "seed": SEED,
        "generation": {"max-examples": EXAMPLES, "deterministic": True, "mode": "all"},
        "checks": {"positive_data_acceptance": {"expected-statuses": accepted}},
        "phases": {"coverage": {"enabled": every_value}},
        # The process that reads large bodies is nice: on a busy machine it begins late.
        "request-timeout": 120.0,
    }
    schema = schemathesis.openapi.from_dict(DOCUMENT, config=SchemathesisConfig.from_dict(config))
    schema.app = relay
    return schema


# 304, 412: an ETag that is, or is not, the resource's.
PLAIN = contract(["2xx", "304", "404", "409", "412"])
WITH_RULES = contract(["2xx", "304", "404", "409", "412", "422"])
# What they take is what another operation takes, where every value of each setting is tried; a
# thousand pictures take minutes.
LIKE_OTHERS = {
    "draw-peaks": (contract(["2xx", "422"], every_value=False), "find-peaks"),
    "get-plan-picture": (contract(["2xx", "404", "409"], every_value=False), "get-plan"),
    "change-device": (
        contract(["2xx", "404", "409", "412", "422"], every_value=False),
        "create-device",
    ),
}
OWN = {
    "draw-peaks": {"scan"},
    "change-device": {"device_id", "If-Match"},
    "get-plan-picture": set(),
}
"""What they take beside, of which some values are drawn only."""
# Calibrations with all settings, and reports, take about a second each.
LONG = contract(["2xx", "304", "404", "409", "422"], every_value=False)


def not_connected(_: Any) -> None:
    raise DeviceNotConnected("nothing is connected here")


@pytest.fixture(scope="module", autouse=True)
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Run the application to which the schema's requests go."""
    data_dir = tmp_path_factory.mktemp("contract")
    # Hundreds of runs are posted, and all but a few wait until the server ends.
    # Every request has a key, so that Schemathesis can send it without: that must be refused.
    settings = Settings(
        data_dir=data_dir,
        runs_waiting=1_000_000,
        authentication="required",
        failed_logins_per_minute=10_000,
    )
    relay.app = create_app(settings, FakePipeline())
    with TestClient(relay.app), pytest.MonkeyPatch.context() as patch:
        # Generated ports and cameras are not looked for: seconds for each, and on real networks.
        for driver in (SerialDriver, Tcd1304Driver, GenicamDriver):
            patch.setattr(driver, "open", not_connected)
        with relay.app.state.database.write() as session:
            _, made = add_key(session, name="contract", scopes=SCOPES)
        relay.key = made.text
        yield


fresh = itertools.count()
wrong_values: Counter[tuple[str, str]] = Counter()
"""How many came at each place of each operation's body."""


def tried_in_turn(case: Any) -> bool:
    """Whether this is a value of a wrong type that is left to other places of the body.

    Five such values come at each of a thousand places, which are read as one of a few types: two
    are sent, and at the next place the next two.
    """
    phase, data = case.meta.phase.name, case.meta.phase.data
    if phase is not TestPhase.COVERAGE or case.meta.generation.mode.is_positive:
        return False
    place = data.location or ""
    if data.parameter_location is not ParameterLocation.BODY or not place.endswith("/type"):
        return False
    operation_id = case.operation.definition.raw["operationId"]
    at = (operation_id, place)
    if at not in wrong_values:
        wrong_values[at] = 2 * sum(1 for one, _ in wrong_values if one == operation_id)
    wrong_values[at] += 1
    return wrong_values[at] % 5 >= 2


def check_contract(case: Any) -> None:
    if tried_in_turn(case):
        return
    fits = case.meta.generation.mode.is_positive
    operation_id = case.operation.definition.raw["operationId"]
    if fits and "Idempotency-Key" in case.headers:
        # One of another request is refused.
        case.headers["Idempotency-Key"] = f"key-{next(fresh)}"
    if fits and operation_id.startswith("create-") and operation_id not in WITHOUT_ID:
        # Ids are examples, or drawn from few: most would be taken, and the rest not looked at.
        case.body["id"] = f"new-{next(fresh)}"
        case.body.pop("result_id", None)
    # Of requests whose headers are wrong on purpose the missing key may be what is wrong.
    header = case.meta.components.get(ParameterLocation.HEADER)
    own = header is not None and header.mode.is_negative
    excluded = [positive_data_acceptance] if own else []
    if operation_id in ANOTHER_METHOD_MAY_BE:
        excluded += [unsupported_method, allow_header_conformance]
    answer = case.call_and_validate(
        headers={} if own else {"Authorization": f"Bearer {relay.key}"},
        excluded_checks=excluded,
    )
    if fits and answer.status_code == 422:
        # A rule beyond the schema has a type of its own.
        assert answer.json()["type"] != "/problems/invalid-request", answer.text
    body = case.meta.components.get(ParameterLocation.BODY)
    if case.meta.phase.name is TestPhase.COVERAGE and body is not None and body.mode.is_negative:
        # That an id is taken or a device is none (409, 404) would say nothing of the body. What a
        # set holds twice it may be sent twice.
        place = case.meta.phase.data.location or ""
        refused = answer.status_code in (400, 401, 413, 415, 422)
        assert refused or place.endswith("/uniqueItems"), answer.text


def contract_test(operation_id: str) -> Any:
    schema = WITH_RULES if operation_id in RULES_BEYOND_THE_SCHEMA else PLAIN
    schema = LONG if operation_id in ("create-calibration", "get-calibration-report") else schema
    schema, _ = LIKE_OTHERS.get(operation_id, (schema, None))

    def test(request: pytest.FixtureRequest) -> None:
        @schema.include(operation_id=operation_id).parametrize()
        def test_requests(case: Any) -> None:
            check_contract(case)

        # Schemathesis makes an operation's requests where it collects a test: for all of them half
        # a minute, in every process that collects these, to run or not. So only now.
        collector = request.config.hook.pytest_pycollect_makeitem(
            collector=request.node.parent, name="test_requests", obj=test_requests
        )
        [requests] = collector.collect()
        requests.obj()

    return test


def test_what_is_tried_elsewhere_is_the_same() -> None:
    """Operations that leave values to another take no setting that the other does not."""
    document = openapi_document()
    described = {
        operation["operationId"]: operation
        for path_item in document["paths"].values()
        for operation in path_item.values()
    }

    def taken(operation_id: str) -> dict[str, Any]:
        operation = described[operation_id]
        found = {one["name"]: one["schema"] for one in operation.get("parameters", ())}
        for content in operation.get("requestBody", {}).get("content", {}).values():
            name = content["schema"]["$ref"].rpartition("/")[2]
            found |= document["components"]["schemas"][name]["properties"]
        return {name: essence(schema) for name, schema in found.items()}

    def essence(schema: dict[str, Any]) -> dict[str, Any]:
        words = ("title", "description", "default", "examples")
        return {key: value for key, value in schema.items() if key not in words}

    for operation_id, (_, other) in LIKE_OTHERS.items():
        ours, theirs = taken(operation_id), taken(other)
        own = {name for name in ours if ours[name] != theirs.get(name)}
        assert own <= OWN.get(operation_id, set()), operation_id


# One function for each operation: Schemathesis's own items all have the function's node id, by
# which pytest-xdist tells tests apart, and would run one operation only.
for path_item in openapi_document()["paths"].values():
    for operation in path_item.values():
        name = operation["operationId"]
        globals()[f"test_{name.replace('-', '_')}"] = contract_test(name)
