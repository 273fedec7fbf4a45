"""BusConnection: one connection to NATS, which is made again and again until it is closed.

All of it runs in the event loop that it was opened in. Nothing is kept for a broker that is away:
what is published meanwhile is lost, and readers count it.
"""

import asyncio
import logging
import ssl
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import nats.errors
from nats.aio.client import Client
from nats.aio.msg import Msg

from service.problems.errors import StationNotReached

_log = logging.getLogger(__name__)

CONNECT_S: Final = 3.0
"""Within which a broker has to answer a connection."""
AGAIN_S: Final = (0.05, 0.2, 0.5, 1.0)
"""Until the next attempt; the last for all that follow."""
PING_S: Final = 1.0
"""Time between two questions whether the broker is still there; two without an answer end it."""
BACKLOG_BYTES: Final = 1 << 20
"""What may wait for the broker to take it; publishers keep what is more."""
_PENDING_BYTES: Final = 4 << 20
_LOOK_S: Final = 0.05

Handler = Callable[[str, bytes, str], None]
"""Takes subject, message, and the subject of its answer, empty where none is wanted."""


@dataclass(frozen=True)
class BusOptions:
    """How the bus is reached.

    Args:
        urls: of brokers, ``nats://host:4222`` or ``tls://...``; any of them.
        nkey_seed: file with the seed of an NKey; None: without.
        credentials: file with a JWT and its seed (``.creds``); None: without.
        token_file: file with a token; None: without.
        ca: file with the certificate of who signed the broker's; None: the system's. With it, or
            a URL that begins with tls, nothing is sent without TLS.
    """

    urls: tuple[str, ...]
    nkey_seed: Path | None = None
    credentials: Path | None = None
    token_file: Path | None = None
    ca: Path | None = None

    @property
    def secure(self) -> bool:
        """Whether there has to be TLS."""
        return self.ca is not None or any(url.startswith("tls:") for url in self.urls)

    @property
    def shown(self) -> str:
        """The URLs as messages show them: without passwords."""
        return ", ".join(url.rpartition("@")[2].rpartition("/")[2] for url in self.urls)


class _SecureClient(Client):
    """Sends nothing, above all no password, to a broker that offers no TLS where it has to."""

    secure = False

    def _connect_command(self) -> bytes:
        writer = getattr(self._transport, "_io_writer", None)
        if self.secure and (writer is None or writer.get_extra_info("ssl_object") is None):
            raise nats.errors.Error("the broker offers no TLS, and the settings ask for it")
        command: bytes = super()._connect_command()
        return command

    def abort(self) -> None:
        """Let go of the connection without a word more."""
        writer = getattr(self._transport, "_io_writer", None)
        if writer is not None:
            writer.transport.abort()
        for task in (self._reading_task, self._flusher_task, self._ping_interval_task):
            if task is not None:
                task.add_done_callback(_retrieve)
                task.cancel()


@dataclass(eq=False)
class _Subscription:
    subject: str
    handler: Handler
    limit_bytes: int
    active: Any = None


class BusConnection:
    """Publishes, asks and subscribes; made and used in one event loop.

    Args:
        options: how the broker is reached.
        name: shown by the broker.
        inbox_prefix: of the subjects of answers.
        changed: called when the connection was made, or is lost.
    """

    def __init__(
        self,
        options: BusOptions,
        name: str,
        inbox_prefix: str,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self._options = options
        self._name = name
        self._inbox_prefix = inbox_prefix
        self._changed = changed
        self._client: _SecureClient | None = None
        self._subscriptions: list[_Subscription] = []
        self._why: str | None = "no connection was made yet"
        self._task: asyncio.Task[None] | None = None
        self._closing = False

    def open(self) -> None:
        """Begin to connect; does not wait for it."""
        self._task = asyncio.get_running_loop().create_task(self._keep_connected())

    @property
    def connected(self) -> bool:
        """Whether there is a connection now."""
        return self._client is not None and bool(self._client.is_connected)

    @property
    def reason(self) -> str:
        """Why there is none, in words."""
        return f"the bus at {self._options.shown} is not reached: {self._why}"

    @property
    def max_payload(self) -> int:
        """Largest message that the broker takes [bytes]."""
        return int(self._client.max_payload) if self._client is not None else 1 << 20

    @property
    def backlog(self) -> int:
        """Bytes that wait for the broker to take them."""
        return int(self._client.pending_data_size) if self._client is not None else 0

    async def publish(self, subject: str, data: bytes, reply: str = "") -> None:
        """Publish a message; without a connection, or with a full one, it is lost."""
        client = self._client
        if client is not None and client.is_connected:
            with suppress(nats.errors.Error, OSError):
                await client.publish(subject, data, reply)

    async def request(self, subject: str, data: bytes, timeout_s: float) -> bytes:
        """Return the answer to a request.

        Raises:
            StationNotReached: there is no connection, nobody answers requests of this subject, or
                there was no answer in time.
        """
        client = self._client
        if client is None or not client.is_connected:
            raise StationNotReached(f"{self.reason}; try again", part="bus")
        try:
            answer = await client.request(subject, data, timeout_s)
        except nats.errors.NoRespondersError as error:
            raise StationNotReached("nobody is there", part="station") from error
        except (nats.errors.TimeoutError, TimeoutError) as error:
            raise StationNotReached(f"no answer within {timeout_s:g} s", part="station") from error
        except (nats.errors.Error, OSError, asyncio.CancelledError) as error:
            if isinstance(error, asyncio.CancelledError) and not client.is_closed:
                raise
            raise StationNotReached(f"{self.reason}; try again", part="bus") from error
        return bytes(answer.data)

    async def subscribe(
        self, subject: str, handler: Handler, limit_bytes: int = 32 << 20
    ) -> _Subscription:
        """Give all messages of a subject to a handler, with every connection from now on.

        Args:
            subject: with wildcards.
            handler: called in the event loop.
            limit_bytes: what may wait for it before more is thrown away.
        """
        one = _Subscription(subject, handler, limit_bytes)
        self._subscriptions.append(one)
        if self._client is not None and self._client.is_connected:
            await self._subscribe(self._client, one)
            with suppress(nats.errors.Error, OSError):
                await self._client.flush(2)
        return one

    async def unsubscribe(self, one: _Subscription) -> None:
        """End a subscription; may be called again."""
        if one in self._subscriptions:
            self._subscriptions.remove(one)
            if one.active is not None:
                with suppress(nats.errors.Error, OSError):
                    await one.active.unsubscribe()

    async def close(self) -> None:
        """Send what waits, and end the connection."""
        self._closing = True
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task
        client, self._client = self._client, None
        if client is not None:
            with suppress(TimeoutError, nats.errors.Error, OSError):
                async with asyncio.timeout(CONNECT_S):
                    await client.flush(1)
                    await client.close()
            client.abort()

    async def _subscribe(self, client: Client, one: _Subscription) -> None:
        async def handle(message: Msg) -> None:
            try:
                one.handler(message.subject, message.data, message.reply)
            except Exception:  # noqa: BLE001 - of this message; the next ones go on
                _log.exception("a message of the bus (%s) was not understood", message.subject)

        one.active = await client.subscribe(
            one.subject, cb=handle, pending_bytes_limit=one.limit_bytes
        )

    async def _keep_connected(self) -> None:
        attempt = 0
        while True:
            client = _SecureClient()
            client.secure = self._options.secure
            try:
                await self._connect(client)
            except (nats.errors.Error, OSError, TimeoutError, ValueError, ImportError) as error:
                why = str(self._error or error) or type(error).__name__
                if why != self._why:
                    self._why = why
                    _log.warning("%s", self.reason)
                client.abort()
                await asyncio.sleep(AGAIN_S[min(attempt, len(AGAIN_S) - 1)])
                attempt += 1
                continue
            attempt, self._why, self._client = 0, None, client
            _log.info("connected to the bus at %s", self._options.shown)
            self._changed()
            while client.is_connected:
                await asyncio.sleep(_LOOK_S)
            # Its own end would wait for a link that is cut.
            client.abort()
            self._client, self._why = None, str(self._error or "the connection has ended")
            _log.warning("%s", self.reason)
            self._changed()

    async def _connect(self, client: _SecureClient) -> None:
        options = self._options
        self._error: Exception | None = None

        async def failed(error: Exception) -> None:
            self._error = error
            _log.debug("bus: %r", error)

        async with asyncio.timeout(CONNECT_S):
            await client.connect(
                servers=list(options.urls),
                name=self._name,
                error_cb=failed,
                allow_reconnect=False,
                max_reconnect_attempts=1,
                reconnect_time_wait=0.05,  # type: ignore[arg-type]  # seconds, and fractions work
                connect_timeout=2,
                ping_interval=PING_S,  # type: ignore[arg-type]
                max_outstanding_pings=2,
                tls=ssl.create_default_context(cafile=options.ca) if options.secure else None,
                token=_text_of(options.token_file),
                user_credentials=None if options.credentials is None else str(options.credentials),
                nkeys_seed=None if options.nkey_seed is None else str(options.nkey_seed),
                inbox_prefix=self._inbox_prefix,
                pending_size=_PENDING_BYTES,
                flush_timeout=1.0,
            )
            for one in self._subscriptions:
                await self._subscribe(client, one)
            await client.flush(2)


def _retrieve(task: asyncio.Task[Any]) -> None:
    """Take how a task of a lost connection has ended: it is known already."""
    if not task.cancelled():
        task.exception()


def _text_of(file: Path | None) -> str | None:
    return None if file is None else file.read_text(encoding="utf-8").strip()
