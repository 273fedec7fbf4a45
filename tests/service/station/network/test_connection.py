"""BusConnection with a real broker: lost and found again, secured, and never waited for."""

import asyncio
import datetime
import os
import ssl
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from service.problems.errors import StationNotReached
from service.station.network.connection import BusConnection, BusOptions
from service.station.network.envelope import unpack
from service.station.network.outbox import QUEUE_BYTES, Outbox
from tests.nats_server import NatsServer
from tests.service.station.network.conftest import eventually


def connection(options: BusOptions, name: str = "one") -> BusConnection:
    return BusConnection(options, name, f"lumiline.v1.inbox.{name}")


def test_what_is_lost_is_connected_again_with_all_subscriptions(broker: NatsServer) -> None:
    async def run() -> None:
        one, other = connection(BusOptions((broker.url,))), connection(BusOptions((broker.url,)))
        taken: list[bytes] = []
        await one.subscribe("lumiline.v1.*.state", lambda _s, data, _r: taken.append(data))
        one.open()
        other.open()
        for message in (b"first", b"second"):
            await eventually(lambda: one.connected and other.connected)
            await other.publish("lumiline.v1.bar.state", message)
            await eventually(lambda expected=message: taken and taken[-1] == expected)
            if message == b"first":
                broker.kill()
                await eventually(lambda: not one.connected and not other.connected)
                await other.publish("lumiline.v1.bar.state", b"lost")
                assert "is not reached" in one.reason
                broker.start()
        assert taken == [b"first", b"second"]
        await one.close()
        await other.close()

    asyncio.run(run())


def test_broker_that_hangs_is_lost(broker: NatsServer) -> None:
    async def run() -> None:
        one = connection(BusOptions((broker.url,)))
        one.open()
        await eventually(lambda: one.connected)
        broker.freeze()
        await eventually(lambda: not one.connected)
        broker.thaw()
        await eventually(lambda: one.connected)
        await one.close()

    asyncio.run(run())


def test_requests_are_answered_or_say_why_not(broker: NatsServer) -> None:
    async def run() -> None:
        one = connection(BusOptions((broker.url,)))
        with pytest.raises(StationNotReached, match=r"the bus at .* is not reached"):
            await one.request("lumiline.v1.bar.call.start", b"", 1.0)
        one.open()
        await eventually(lambda: one.connected)
        with pytest.raises(StationNotReached, match="nobody is there"):
            await one.request("lumiline.v1.bar.call.start", b"", 30.0)

        def answer(subject: str, data: bytes, reply: str) -> None:
            if data != b"never":
                tasks.append(asyncio.ensure_future(one.publish(reply, data * 2)))

        tasks: list[asyncio.Future[None]] = []
        await one.subscribe("lumiline.v1.bar.call.*", answer)
        assert await one.request("lumiline.v1.bar.call.start", b"ab", 30.0) == b"abab"
        with pytest.raises(StationNotReached, match=r"no answer within 0\.05 s"):
            await one.request("lumiline.v1.bar.call.start", b"never", 0.05)
        await one.close()

    asyncio.run(run())


def certificate(folder: Path) -> tuple[Path, Path]:
    """Make a certificate of 127.0.0.1 that signs itself; return its file and its key's."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "broker")])
    now = datetime.datetime.now(datetime.UTC)
    import ipaddress

    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(
            x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]),
            critical=False,
        )
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    files = folder / "broker.pem", folder / "broker.key"
    files[0].write_bytes(made.public_bytes(serialization.Encoding.PEM))
    files[1].write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    return files


def seed_and_public(folder: Path) -> tuple[Path, str]:
    """Make an NKey; return the file of its seed, and its public key."""
    nkeys = pytest.importorskip("nkeys")
    encoded = nkeys.encode_seed(bytes(range(32)), nkeys.PREFIX_BYTE_USER)
    file = folder / "gateway.nk"
    file.write_bytes(encoded)
    return file, nkeys.from_seed(bytearray(encoded)).public_key.decode()


def test_tls_and_nkey_let_in_who_has_them_for_what_they_may(tmp_path: Path) -> None:
    cert, key = certificate(tmp_path)
    seed, public = seed_and_public(tmp_path)
    broker = NatsServer(
        tmp_path,
        f"""
        tls {{ cert_file: "{cert}", key_file: "{key}" }}
        authorization {{
          users: [
            {{ nkey: "{public}", permissions: {{
                publish: ["lumiline.v1.bar.call.>", "_INBOX.>"]
                subscribe: ["lumiline.v1.*.state", "lumiline.v1.inbox.one.>"]
            }} }}
          ]
        }}
        """,
    )
    broker.start()

    async def run() -> None:
        taken: list[bytes] = []
        one = connection(BusOptions((broker.url,), nkey_seed=seed, ca=cert))
        await one.subscribe("lumiline.v1.*.state", lambda _s, data, _r: taken.append(data))
        await one.subscribe("lumiline.v1.bar.batch.*", lambda _s, data, _r: taken.append(data))
        one.open()
        await eventually(lambda: one.connected)
        # What it may not say is not said; and the connection goes on.
        await one.publish("lumiline.v1.bar.state", b"forged")
        with pytest.raises(StationNotReached, match="nobody is there"):
            await one.request("lumiline.v1.bar.call.start", b"", 30.0)
        assert taken == []
        assert one.connected
        await one.close()

        stranger = connection(BusOptions((broker.url,), ca=cert))
        stranger.open()
        await eventually(lambda: "Authorization" in stranger.reason)
        await stranger.close()

        distrusting = connection(BusOptions((broker.url.replace("nats:", "tls:"),), seed))
        distrusting.open()
        await eventually(lambda: "certificate" in distrusting.reason)
        await distrusting.close()

    try:
        asyncio.run(run())
    finally:
        broker.kill()


def test_nothing_is_sent_to_a_broker_without_tls_where_it_is_asked_for(
    tmp_path: Path, broker: NatsServer
) -> None:
    token = tmp_path / "token"
    token.write_text("secret", encoding="utf-8")

    async def run() -> None:
        url = broker.url.replace("nats:", "tls:")
        one = connection(BusOptions((url,), token_file=token))
        one.open()
        await eventually(lambda: "offers no TLS" in one.reason)
        assert not one.connected
        await one.close()

    asyncio.run(run())
    assert ssl.OPENSSL_VERSION  # of what the other test uses


def test_token_lets_in_who_has_it(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("secret\n", encoding="utf-8")
    broker = NatsServer(tmp_path, 'authorization { token: "secret" }')
    broker.start()

    async def run() -> None:
        one = connection(BusOptions((broker.url,), token_file=token))
        one.open()
        await eventually(lambda: one.connected)
        await one.close()

    try:
        asyncio.run(run())
    finally:
        broker.kill()


def test_outbox_waits_for_no_broker_and_counts_what_nobody_took(broker: NatsServer) -> None:
    async def run() -> None:
        sender = connection(BusOptions((broker.url,)), "sender")
        outbox = Outbox("bar", "one", sender, 0.01)
        outbox.put(("state",), b"nobody hears this")
        assert outbox.dropped == 1
        reader = connection(BusOptions((broker.url,)), "reader")
        taken: list[int] = []
        await reader.subscribe(
            "lumiline.v1.bar.batch.*", lambda _s, data, _r: taken.append(unpack(data).number)
        )
        for one in (sender, reader):
            one.open()
        await eventually(lambda: sender.connected and reader.connected)
        for _ in range(5):
            outbox.collect(("batch", "bar"), b"a frame", 1)
        await eventually(lambda: taken == [0])  # together
        broker.freeze()
        megabyte = os.urandom(900_000)
        for _ in range(60):
            outbox.put(("poses", "bar"), megabyte)
            await asyncio.sleep(0.001)
        assert sender.connected  # it does not know better yet
        assert 0 < outbox._queued_bytes <= QUEUE_BYTES
        assert outbox.dropped > 1
        broker.thaw()
        await eventually(lambda: sender.connected and reader.connected)
        outbox.put(("batch", "bar"), b"the newest")
        await eventually(lambda: taken and taken[-1] == outbox.positions["batch.bar"])
        assert taken == sorted(set(taken))
        await outbox.close()
        await sender.close()
        await reader.close()

    asyncio.run(run())
