"""MQTT endpoint of one plate: its topics below its name, and its commands."""

from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any
from urllib.parse import quote

from resonator_daemon.base.host.files import state_directory
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config import Config
from resonator_daemon.mqtt import asyncapi
from resonator_daemon.mqtt.codec import Encoded, Outgoing, decoded, encode
from resonator_daemon.mqtt.commands import Commands, Handler
from resonator_daemon.mqtt.daemon_state import DaemonState
from resonator_daemon.mqtt.event_log import EventPage
from resonator_daemon.mqtt.payloads import Message, MessageAccount, State
from resonator_daemon.mqtt.publisher import FRESH_S, Publisher, Subscription
from resonator_daemon.mqtt.topics import JSON, SCHEMA_PATH, STATE_DAEMON, TOPICS, Topic, full_topic

MakeOffline = Callable[[Reason], State]


class PlatePublisher:
    """MQTT endpoint of one plate: publishes its topics and subscribes to its commands.

    Until the name is known, the last state of each topic waits.

    Parameters
    ----------
    config
    daemon_boot_id
        Of this run.
    make_offline
        Makes the state "offline" of the daemon for a reason: the last will, and the farewell.

    """

    def __init__(self, config: Config, daemon_boot_id: str, make_offline: MakeOffline) -> None:
        self._config = config
        self._daemon_boot_id = daemon_boot_id
        self._allowed: Collection[str] = config.commands.allow
        self._make_offline = make_offline
        self._publisher: Publisher | None = None
        self._commands: Commands | None = None
        self._name = self._base = ""
        self._waiting: dict[Topic[Any], Message] = {}
        self._last: dict[str, Message | Encoded] = {}

    @property
    def open(self) -> bool:
        return self._publisher is not None

    @property
    def connected(self) -> bool:
        return self._publisher is not None and self._publisher.connected

    @property
    def account(self) -> MessageAccount:
        """Where the messages went."""
        return self._publisher.account if self._publisher else MessageAccount()

    def losses(self) -> tuple[int, int]:
        """Return the numbers of messages that were dropped, and of those that were skipped as late."""
        if self._publisher is None:
            return 0, 0
        counts = self._publisher.counts
        return counts.missed, counts.late

    @property
    def command_counts(self) -> dict[str, int]:
        """Commands by what became of them."""
        return dict(self._commands.counts) if self._commands else {}

    def last_message(self, path: str) -> Message | None:
        """Return the last message of the JSON topic with this path; None where there was none."""
        last = self._last.get(path)
        return decoded(TOPICS[path].payload, last) if last is not None else None

    def publish(self, topic: Topic[Any], message: Message | Encoded) -> None:
        if topic.content_type == JSON:
            self._last[topic.path] = message
        if self._publisher is not None:
            self._publisher.publish(self._base, topic, message)
        elif topic.retained and isinstance(message, Message):
            self._waiting[topic] = message

    def batch(self) -> AbstractContextManager[None]:
        """Send what is published within this context as one batch, at its end."""
        return self._publisher.batch() if self._publisher is not None else nullcontext()

    def begin(self, name: str, handlers: Mapping[str, Handler], daemon_state: DaemonState) -> None:
        """Set the name; `run` connects and publishes the waiting states first."""
        broker = self._config.mqtt
        self._name, self._base = name, f"{broker.prefix}/{name}"
        self._commands = Commands(self._base, handlers, self._allowed, lambda answer: publisher.answer(answer))
        self._publisher = publisher = Publisher(
            broker,
            identifier=f"resonatord-{broker.prefix}-{name}-{self._daemon_boot_id}",
            make_will=self._make_will,
            subscriptions=(
                Subscription(self._commands.topic_filter, 1, self._commands.receive, retain_as_published=True),
                Subscription(full_topic(broker.prefix, name, STATE_DAEMON.path), 1, daemon_state.receive),
            ),
            spool_directory=state_directory() / "spool" / quote(broker.prefix, safe="") / name,
            boot_id=self._daemon_boot_id,
            on_connected=daemon_state.connected,
            stream_wait_max_s=FRESH_S,
        )
        publisher.retain(full_topic(broker.prefix, name, SCHEMA_PATH), asyncapi.encoded(), JSON)
        for topic, message in self._waiting.items():
            publisher.publish(self._base, topic, message.model_copy(update={"name": name}))
        self._waiting.clear()

    def restore_now(self) -> None:
        """Publish all retained messages again: another client has overwritten some."""
        if self._publisher is not None:
            self._publisher.restore_now()

    async def run(self) -> None:
        """Keep connected until `close`."""
        if self._publisher is not None:
            await self._publisher.run()

    def set_allowed(self, verbs: Collection[str]) -> None:
        """Set the commands that are permitted, in addition to those that change nothing."""
        self._allowed = verbs
        if self._commands is not None:
            self._commands.allowed = verbs

    async def stored_events(self, boot_id: str | None, after_seq: int, bytes_max: int) -> EventPage:
        """Return stored events of a run, the present one where not given, beyond `after_seq`."""
        if self._publisher is None:
            return EventPage((), complete=True, oldest_seq=None, newest_seq=None)
        return await self._publisher.stored_events(boot_id, after_seq, bytes_max)

    async def close(self, *, wait_for_broker: bool) -> None:
        """Answer pending commands, publish that the daemon stopped, and end `run`."""
        if self._commands is not None:
            await self._commands.close()
        if self._publisher is not None:
            farewell = (self._base, STATE_DAEMON, self._make_offline(Reason(ReasonCode.STOPPED, "stopped")))
            await self._publisher.close(farewell, wait_for_broker=wait_for_broker)

    def _make_will(self) -> Outgoing:
        lost = Reason(ReasonCode.CONNECTION_LOST, "connection lost")
        will = self._make_offline(lost).model_copy(update={"since_t_ns": None})
        return Outgoing(f"{self._base}/{STATE_DAEMON.path}", encode(will), retained=STATE_DAEMON.retained)
