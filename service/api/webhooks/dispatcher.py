"""WebhookDispatcher: a thread that takes events from anywhere and hands them to deliveries."""

import asyncio
import contextlib
import json
import logging
import secrets
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from threading import Thread
from typing import Annotated, Any, Final

from sqlalchemy import select

from compute.errors import LumilineError
from service.api.inputs import of_application
from service.api.webhooks.delivery import FIRST_DELAY_S, Message, Target, WebhookDelivery
from service.api.webhooks.schema import Event, WebhookState
from service.database.engine import Database
from service.database.models import WebhookRow

_log = logging.getLogger(__name__)

RELOAD_S: Final = 10.0
"""How often webhooks are read again: another server on the same database may have changed them."""
_CALL_S: Final = 5.0
TEST_EVENT: Final = "webhook.test"


def _utc_now() -> datetime:
    return datetime.now(UTC)


class WebhookDispatcher:
    """Delivers events; ``emit`` may be called from any thread and never waits.

    Args:
        database: has the webhooks.
        now: the time.
        first_delay_s: as of ``WebhookDelivery``.
    """

    def __init__(
        self,
        database: Database,
        now: Callable[[], datetime] = _utc_now,
        first_delay_s: float = FIRST_DELAY_S,
    ) -> None:
        self._database = database
        self._now = now
        self._first_delay_s = first_delay_s
        self._deliveries: dict[str, WebhookDelivery] = {}
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._run, name="webhooks", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread; what was not delivered is lost."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(10.0)

    def emit(self, event_type: str, data: dict[str, Any]) -> None:
        """Send an event to the webhooks that want it."""
        self._call(self._put, event_type, data, None)

    def test(self, webhook_id: str) -> None:
        """Send a test event to one webhook."""
        self.reload()
        self._call(self._put, TEST_EVENT, {"webhook_id": webhook_id}, webhook_id)

    def reload(self) -> None:
        """Read the webhooks again, now."""
        asyncio.run_coroutine_threadsafe(self._reload(), self._loop).result(_CALL_S)

    def states(self) -> dict[str, WebhookState]:
        """Return how the deliveries of each webhook stand."""
        return {name: one.document() for name, one in tuple(self._deliveries.items())}

    def _call(self, function: Callable[..., None], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the server ends
            self._loop.call_soon_threadsafe(function, *arguments)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        task = self._loop.create_task(self._reload_forever())
        self._loop.run_forever()
        tasks = [task, *(one.task for one in self._deliveries.values())]
        for one in tasks:
            one.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        # What is being read is read to its end: the database is closed after this.
        self._loop.run_until_complete(self._loop.shutdown_default_executor())
        self._loop.close()

    async def _reload_forever(self) -> None:
        while True:
            await self._reload()
            await asyncio.sleep(RELOAD_S)

    async def _reload(self) -> None:
        try:
            targets = await asyncio.to_thread(self._targets)
        except LumilineError as error:
            _log.warning("webhooks are not read now: %s", error.detail)
            return
        self._take(targets)

    def _targets(self) -> list[Target]:
        with self._database.read() as session:
            return [
                Target(row.id, row.url, row.secret, frozenset(row.event_types), row.enabled)
                for row in session.scalars(select(WebhookRow))
            ]

    def _take(self, targets: Iterable[Target]) -> None:
        """Go on with changed webhooks as they are now, and end those that were deleted."""
        wanted = {target.id: target for target in targets}
        for gone in self._deliveries.keys() - wanted.keys():
            self._deliveries.pop(gone).task.cancel()
        for target in wanted.values():
            delivery = self._deliveries.get(target.id)
            # Deleted and made again under the same id it is another one, with another secret.
            if delivery is not None and delivery.target.secret != target.secret:
                delivery.task.cancel()
                delivery = None
            if delivery is None:
                self._deliveries[target.id] = WebhookDelivery(
                    target, self._now, self._first_delay_s
                )
            else:
                delivery.target = target

    def _put(self, event_type: str, data: dict[str, Any], only: str | None) -> None:
        event = Event(type=event_type, timestamp=self._now().isoformat(), data=data)
        text = json.dumps(event.model_dump(), allow_nan=False, separators=(",", ":"))
        message = Message(f"msg_{secrets.token_hex(12)}", text.encode())
        for name, delivery in self._deliveries.items():
            target = delivery.target
            wanted = name == only if only else event_type in target.event_types
            if wanted and target.enabled:
                delivery.put(message)


WebhooksDep = Annotated[WebhookDispatcher, of_application("webhooks")]
