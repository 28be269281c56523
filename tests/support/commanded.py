"""As much of a daemon as commands need: a publisher that hears them and answers."""

import asyncio
from collections.abc import AsyncIterator, Collection, Mapping
from contextlib import asynccontextmanager

from example_messages import header
from observer import until

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.codec import Outgoing
from resonator_daemon.mqtt.commands import Commands, Handler
from resonator_daemon.mqtt.payloads import State
from resonator_daemon.mqtt.publisher import Publisher, Subscription
from resonator_daemon.mqtt.topics import STATE_DAEMON


def state(condition: str, reason: str) -> State:
    return State(**header(), state=condition, reason=reason, since_t_ns=None)


class Commanded:
    """A publisher of one name and the commands to it."""

    def __init__(self, url: str, handlers: Mapping[str, Handler], allowed: Collection[str], name: str) -> None:
        self.base = f"resonator/{name}"
        self.commands = Commands(self.base, handlers, allowed, lambda answer: self.publisher.answer(answer))
        self.publisher = Publisher(
            Mqtt(url=url),
            identifier=f"test-{name}",
            make_will=lambda: Outgoing(f"{self.base}/state/daemon", b"gone", retained=True),
            subscriptions=(Subscription(self.commands.topic_filter, 1, self.commands.receive),),
        )


@asynccontextmanager
async def commanded(
    url: str, handlers: Mapping[str, Handler], allowed: Collection[str] = (), name: str = "left"
) -> AsyncIterator[Commanded]:
    """Run one, which is connected; at the end it publishes that it stopped."""
    daemon = Commanded(url, handlers, allowed, name)
    running = asyncio.create_task(daemon.publisher.run())
    try:
        await until(lambda: daemon.publisher.connected)
        yield daemon
    finally:
        await daemon.commands.close()
        farewell = (daemon.base, STATE_DAEMON, state("offline", "stopped"))
        await daemon.publisher.close(farewell, wait_for_broker=True)
        await running
