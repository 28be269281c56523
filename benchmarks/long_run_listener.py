"""Listens to a daemon's messages through restarts of the broker, and judges each as it comes."""

import json
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import paho.mqtt.client as mqtt
from long_run_judge import Seen, account_off
from system_parts import NAME

_TOPICS: Final = ("forces", "contacts/event", "health", "state/link")
_STREAMS: Final = ("forces", "contacts/event")
_KEPT: Final = 50  # findings; a run that goes wrong all the time is no better known by more


class Listener:
    """A subscriber in a thread of its own.

    Parameters
    ----------
    port
        Of the broker.
    seen
        Takes what is found.
    excused
        Tells whether, at a time of the monotonic clock, messages may be missing that the daemon had handed over: a
        broker that died or stood still had them.

    Attributes
    ----------
    health, link
        The last message of `health` and of `state/link`; None before the first.
    """

    def __init__(self, port: int, seen: Seen, excused: Callable[[float], bool]) -> None:
        self._seen = seen
        self._excused = excused
        self._last: dict[str, tuple[int, int]] = {}  # by topic, of this connection: seq, and what was not sent
        self._news = threading.Condition()
        self.health: dict[str, Any] | None = None
        self.link: dict[str, Any] | None = None
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self._client.on_connect = self._connected
        self._client.on_message = self._received
        self._client.reconnect_delay_set(1, 1)
        self._client.connect_async("127.0.0.1", port)
        self._client.loop_start()

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def command(self, verb: str, request: dict[str, object]) -> None:
        """Ask for something; what comes of it is in the counts of `health`."""
        self._client.publish(f"resonator/{NAME}/cmd/{verb}", json.dumps(request))

    def next_health(self, timeout_s: float) -> dict[str, Any] | None:
        """Wait for a message of `health` that is made from now on; None where none comes."""
        with self._news:
            healths, until = self._seen.healths, time.monotonic() + timeout_s
            # The next one may have been on its way already.
            self._news.wait_for(lambda: self._seen.healths >= healths + 2, timeout=until - time.monotonic())
            return self.health if self._seen.healths >= healths + 2 else None

    def _connected(self, client: mqtt.Client, *_: object) -> None:
        self._last.clear()
        client.subscribe([(f"resonator/{NAME}/{topic}", 1) for topic in _TOPICS])

    def _received(self, _client: object, _userdata: object, message: mqtt.MQTTMessage) -> None:
        topic = message.topic.removeprefix(f"resonator/{NAME}/")
        payload = json.loads(message.payload)
        if topic in _STREAMS:
            self._judge(topic, payload)
            return
        with self._news:
            if topic == "state/link":
                self.link = payload
                return
            self.health = payload
            self._seen.healths += 1
            off = account_off(payload)
            if off and len(self._seen.accounts_off) < _KEPT:
                self._seen.accounts_off += off
            self._news.notify_all()

    def _judge(self, topic: str, payload: dict[str, Any]) -> None:
        seen, seq = self._seen, payload["seq"]
        dropped = payload["lost"]["publish_dropped"] + payload["lost"]["skipped_late"]
        seen.messages += 1
        before = self._last.get(topic)
        if before is not None and seq <= before[0]:
            seen.out_of_order += not payload.get("replayed", False)
            return
        self._last[topic] = (seq, dropped)
        if before is None:
            return
        holes = max(0, seq - before[0] - 1 - max(0, dropped - before[1]))
        if self._excused(time.monotonic()):
            seen.holes_excused += holes
        else:
            seen.holes += holes
