"""Commands to the daemon on `cmd/<verb>`, and the answer to each; whatever comes in, the worst it gets is a refusal."""

import asyncio
import json
import logging
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

COMMANDS: Final = "cmd/+"
PAYLOAD_BYTES_MAX: Final = 16 * 1024
WAITING_MAX: Final = 16
VERB_LENGTH_MAX: Final = 64
RESPONSE_TOPIC_BYTES_MAX: Final = 1024
CORRELATION_BYTES_MAX: Final = 1024

log = logging.getLogger(__name__)

Answer = Mapping[str, Any]
Respond = Callable[[Answer], None]
Handler = Callable[[str, dict[str, Any], Respond], None]


class Incoming(NamedTuple):
    """A message as it came; the last two are MQTT 5's, None where the sender gave none."""

    topic: str
    payload: bytes
    retained: bool
    response_topic: str | None
    correlation: bytes | None


class Outgoing(NamedTuple):
    """An answer on its way."""

    topic: str
    payload: bytes
    correlation: bytes | None


class CommandRefusedError(Exception):
    """Raised by a handler instead of an answer: what is wrong, by a word for programs and a sentence for people."""

    def __init__(self, code: str, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.code, self.message, self.hint = code, message, hint


class Commands:
    """Hands commands to one handler, one with each turn of the event loop; to be used from the loop's thread only.

    Parameters
    ----------
    base
        Topics' beginning, prefix and name.
    handler
        Called with verb, payload and the function that answers, at once or later; may raise CommandRefusedError.
    send
        Takes the answer.
    """

    def __init__(self, base: str, handler: Handler, send: Callable[[Outgoing], None]) -> None:
        self._base = base
        self._handler = handler
        self._send = send
        self._waiting: deque[Incoming] = deque()

    @property
    def topic_filter(self) -> str:
        return f"{self._base}/{COMMANDS}"

    def take(self, message: Incoming) -> None:
        """Take a message; returns at once. What was retained is old, and nobody waits for its answer: passed over."""
        if message.retained:
            return
        if len(self._waiting) >= WAITING_MAX:
            self._answer(message, _refusal("busy", f"{WAITING_MAX} commands wait already", "send it again later"))
            return
        if not self._waiting:
            asyncio.get_running_loop().call_soon(self._handle_next)
        self._waiting.append(message)

    def _handle_next(self) -> None:
        message = self._waiting[0]
        try:
            self._handle(message)
        except CommandRefusedError as refused:
            self._answer(message, _refusal(refused.code, refused.message, refused.hint))
        finally:
            self._waiting.popleft()
            if self._waiting:
                asyncio.get_running_loop().call_soon(self._handle_next)

    def _handle(self, message: Incoming) -> None:
        if (topic := message.response_topic) is not None and not self._may_answer_to(topic):
            raise CommandRefusedError(
                "response_topic",
                f"answers do not go to {topic[:80]!a}",
                f"use a topic outside {self._base.partition('/')[0]}/, or below {self._base}/rsp/",
            )
        verb = _verb(message)
        payload = _payload(message.payload)
        self._handler(verb, payload, lambda answer: self._answer(message, answer))

    def _answer(self, message: Incoming, answer: Answer) -> None:
        verb = _verb(message)
        topic, correlation = message.response_topic, message.correlation
        if topic is None or not self._may_answer_to(topic):
            topic = f"{self._base}/rsp/{verb}"
        if correlation is not None and len(correlation) > CORRELATION_BYTES_MAX:
            correlation = None
        self._send(Outgoing(topic, json.dumps({"verb": verb, **answer}, allow_nan=False).encode(), correlation))

    def _may_answer_to(self, topic: str) -> bool:
        """Whether a topic can be published to and is none of a daemon's own, which others believe."""
        sound = topic and topic.isprintable() and len(topic.encode()) <= RESPONSE_TOPIC_BYTES_MAX
        if not sound or any(sign in topic for sign in "+#") or topic.startswith("$"):
            return False
        own = f"{self._base.rpartition('/')[0]}/"
        return topic.startswith(f"{self._base}/rsp/") or not topic.startswith(own)


def _verb(message: Incoming) -> str:
    verb = message.topic.rpartition("/")[2]
    return verb if verb.isprintable() and len(verb) <= VERB_LENGTH_MAX else "unknown"


def _payload(data: bytes) -> dict[str, Any]:
    if len(data) > PAYLOAD_BYTES_MAX:
        raise CommandRefusedError("payload", f"payload of {len(data)} bytes, at most {PAYLOAD_BYTES_MAX}")
    try:
        payload = json.loads(data or b"{}")
    except (ValueError, RecursionError):
        payload = None
    if not isinstance(payload, dict):
        raise CommandRefusedError("payload", "the payload is no JSON object", "send {} where nothing is to be said")
    return payload


def _refusal(code: str, message: str, hint: str = "") -> Answer:
    return {"ok": False, "error": {"code": code, "message": message, "hint": hint}}
