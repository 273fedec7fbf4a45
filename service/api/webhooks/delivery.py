"""WebhookDelivery: sends the events of one webhook in order, with retries and back-off."""

import asyncio
import random
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final
from urllib.parse import urlsplit

import httpx

from service.api.webhooks.schema import DeliveryState, WebhookState
from service.api.webhooks.signature import signed_headers
from service.api.webhooks.target import Address, TargetRefused, check_url, resolve

MAX_WAITING: Final = 256
"""Events of one webhook that wait; beyond it the oldest is dropped: newer ones say more."""
REQUEST_S: Final = 10.0
ATTEMPTS: Final = 8
FIRST_DELAY_S: Final = 1.0
MAX_DELAY_S: Final = 300.0


@dataclass(frozen=True)
class Target:
    """Address and secret of a webhook; the secret is not shown."""

    id: str
    url: str
    secret: str
    event_types: frozenset[str]
    enabled: bool

    def __repr__(self) -> str:
        """Without the secret."""
        return f"Target({self.id!r})"


@dataclass(frozen=True)
class Message:
    """An event that is sent: the same id and body in each attempt."""

    id: str
    body: bytes


def delay_s(attempt: int, first_s: float = FIRST_DELAY_S) -> float:
    """Return how long to wait after an attempt that failed, counted from 1, with jitter."""
    longest = min(first_s * 2.0 ** (attempt - 1), MAX_DELAY_S)
    return longest * random.uniform(0.5, 1.0)  # noqa: S311 - spreads attempts, keeps no secret


class WebhookDelivery:
    """The queue and the task of one webhook; all methods but ``document`` run in the loop.

    Args:
        target: the webhook.
        now: the time.
        first_delay_s: after the first attempt that failed [s].
    """

    def __init__(
        self, target: Target, now: Callable[[], datetime], first_delay_s: float = FIRST_DELAY_S
    ) -> None:
        self.target = target
        self._now = now
        self._first_delay_s = first_delay_s
        self._waiting: deque[Message] = deque()
        self._ready = asyncio.Event()
        self._state: DeliveryState = "idle"
        self.delivered = self.failed = self.dropped = 0
        self._attempted_at: datetime | None = None
        self._reason: str | None = None
        self.task = asyncio.create_task(self._run(), name=f"webhook {target.id}")

    def put(self, message: Message) -> None:
        """Queue an event; never waits."""
        if len(self._waiting) >= MAX_WAITING:
            self._waiting.popleft()
            self.dropped += 1
        self._waiting.append(message)
        self._ready.set()

    def document(self) -> WebhookState:
        """Return how it stands."""
        return WebhookState(
            webhook_id=self.target.id,
            state=self._state if self.target.enabled else "disabled",
            events_waiting=len(self._waiting),
            events_delivered=self.delivered,
            events_failed=self.failed,
            events_dropped=self.dropped,
            attempted_at=self._attempted_at,
            reason=self._reason,
        )

    async def _run(self) -> None:
        while True:
            self._state = "idle"
            self._ready.clear()
            while not self._waiting:
                await self._ready.wait()
            await self._deliver(self._waiting.popleft())

    async def _deliver(self, message: Message) -> None:
        for attempt in range(1, ATTEMPTS + 1):
            if not self.target.enabled:
                self.dropped += 1
                return
            self._state = "delivering"
            self._reason = await self._attempt(message)
            if self._reason is None:
                self.delivered += 1
                return
            if attempt < ATTEMPTS:
                self._state = "retrying"
                await asyncio.sleep(delay_s(attempt, self._first_delay_s))
        self.failed += 1

    async def _attempt(self, message: Message) -> str | None:
        """Send a message once; return why it failed, None where it was taken."""
        now = self._now()
        self._attempted_at = now.astimezone(UTC)
        headers = signed_headers(self.target.secret, message.id, int(now.timestamp()), message.body)
        try:
            async with asyncio.timeout(REQUEST_S):
                status = await _post(self.target.url, message.body, headers)
        except TimeoutError:
            return f"no answer within {REQUEST_S:g} s"
        except TargetRefused as error:
            return str(error)
        except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
            return f"{type(error).__name__}: {error}"[:200]
        return None if 200 <= status < 300 else f"answered with status {status}"


async def _post(url: str, body: bytes, headers: dict[str, str]) -> int:
    """Send a request to the first checked address of a URL's host that can be connected to.

    Redirects are not followed.
    """
    addresses = await resolve(check_url(url))
    connect_s = REQUEST_S / len(addresses)
    for address in addresses[:-1]:
        with suppress(httpx.ConnectError, httpx.ConnectTimeout):
            return await _post_to(address, url, body, headers, connect_s)
    return await _post_to(addresses[-1], url, body, headers, connect_s)


async def _post_to(
    address: Address, url: str, body: bytes, headers: dict[str, str], connect_s: float
) -> int:
    parts = urlsplit(url)
    host = f"[{address}]" if address.version == 6 else str(address)
    netloc = host if parts.port is None else f"{host}:{parts.port}"
    headers = {
        "host": parts.netloc,
        "content-type": "application/json",
        "user-agent": "Lumiline",
        **headers,
    }
    async with (
        httpx.AsyncClient(
            timeout=httpx.Timeout(REQUEST_S, connect=connect_s),
            follow_redirects=False,
            trust_env=False,
        ) as client,
        # The certificate is that of the name, not of the address. The answer's body is not read.
        client.stream(
            "POST",
            parts._replace(netloc=netloc).geturl(),
            content=body,
            headers=headers,
            extensions={"sni_hostname": parts.hostname},
        ) as answer,
    ):
        return answer.status_code
