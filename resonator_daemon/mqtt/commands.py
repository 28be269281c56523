"""Commands to the daemon on `cmd/<verb>`, and the answer to each; a command that cannot be executed is refused."""

import asyncio
import json
import logging
import re
from collections import Counter, deque
from collections.abc import Callable, Collection, Coroutine, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final, NamedTuple

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from resonator_daemon.base.toml import nearest
from resonator_daemon.mqtt import verbs
from resonator_daemon.mqtt.codec import Incoming, Outgoing
from resonator_daemon.mqtt.pacing import TokenBucket

WAITING_MAX: Final = 32
AT_ONCE: Final = 20
PER_SECOND: Final = 10.0
REFUSALS_AT_ONCE: Final = 5  # refusals with "too many"
REFUSALS_PER_SECOND: Final = 1.0
WARN_AGAIN_S: Final = 60.0
DEFERRED_S: Final = 8.0  # less than `requests.ANSWER_S`
RESPONSE_TOPIC_BYTES_MAX: Final = 1024
RESPONSE_TOPIC_LEVELS_MAX: Final = 100  # Mosquitto ends the connection of a client that publishes to more than 200
CORRELATION_BYTES_MAX: Final = 1024
PAYLOAD_BYTES_MAX: Final = 16 * 1024

_FINDINGS_MAX: Final = 5
_SHOWN_LENGTH_MAX: Final = 80
_TEXT_LENGTH_MAX: Final = 1000
_WORD: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_SCHEMA = "see the topic schema, which has each command with its fields"

log = logging.getLogger(__name__)

# The request is of the type that VERBS names; a coroutine where the answer needs longer.
Handler = Callable[[Any], verbs.Answer | Coroutine[Any, Any, verbs.Answer]]


class CommandRefusedError(Exception):
    """Raised by a handler instead of an answer: what is wrong, by a code for programs and a sentence for display."""

    def __init__(self, code: str, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.code, self.message, self.hint = verbs.ErrorCode(code), message, hint


class NotAddressedError(Exception):
    """Raised by a handler if another daemon of the name answers the command."""


class _Command(NamedTuple):
    """A command with the place for its answer."""

    verb: str
    payload: bytes
    topic: str
    correlation: bytes | None
    refused: "CommandRefusedError | None" = None  # whatever the request is


class Commands:
    """Hands commands to their handlers, one with each turn of the event loop; to be used from the loop's thread only.

    Parameters
    ----------
    base
        Topics' beginning, prefix and name.
    handlers
        What does each verb, by its name in VERBS. Called with the request; returns the answer, or a coroutine that
        does, and may raise CommandRefusedError, or NotAddressedError for no answer. Whatever else it raises is answered
        with `failed`.
    allowed
        Verbs that may change something.
    send
        Takes the answers.
    clock
        In seconds; the event loop's where not given.
    deferred_s
        After which a coroutine that has not answered is answered for; it is left to end.
    """

    def __init__(
        self,
        base: str,
        handlers: Mapping[str, Handler],
        allowed: Collection[str],
        send: Callable[[Outgoing], None],
        *,
        clock: Callable[[], float] | None = None,
        deferred_s: float = DEFERRED_S,
    ) -> None:
        self._base = base
        self._handlers = handlers
        self.allowed = allowed
        self._send = send
        self._loop = asyncio.get_running_loop()
        self._deferred_s = deferred_s
        self._bucket = TokenBucket(AT_ONCE, PER_SECOND, clock or self._loop.time)
        self._refusals = TokenBucket(REFUSALS_AT_ONCE, REFUSALS_PER_SECOND, clock or self._loop.time)
        self._warnings = TokenBucket(1, 1 / WARN_AGAIN_S, clock or self._loop.time)
        self._waiting: deque[_Command] = deque()
        self._work: set[asyncio.Task[verbs.Answer]] = set()
        self._finishing: set[asyncio.Task[None]] = set()
        self._logged: set[tuple[str, type[Exception]]] = set()
        self._closed = False
        self.counts: Counter[str] = Counter()  # commands by what became of them: done, an error's code, unanswered

    @property
    def topic_filter(self) -> str:
        return f"{self._base}/cmd/+"

    def receive(self, message: Incoming) -> None:
        """Queue a command; returns at once. Retained messages, and messages after `close`, are ignored."""
        if message.retained:
            return
        if self._closed:
            self.counts["unanswered"] += 1
            return
        command = self._parse(message)
        if not self._bucket.try_acquire():
            self._refuse_excess(command)
        elif len(self._waiting) + len(self._finishing) >= WAITING_MAX:
            self._refuse(command, "busy", f"{WAITING_MAX} commands wait already", "send it again later")
        else:
            if not self._waiting:
                self._loop.call_soon(self._handle_next)
            self._waiting.append(command)

    async def close(self) -> None:
        """Discard the waiting commands without an answer; ignore all later ones."""
        self._closed = True
        self.counts["unanswered"] += len(self._waiting)
        self._waiting.clear()
        for work in self._work:
            work.cancel()
        await asyncio.gather(*self._finishing)

    def _parse(self, message: Incoming) -> _Command:
        word = message.topic.removeprefix(f"{self._base}/cmd/")
        verb = word if word in verbs.VERBS else verbs.UNKNOWN
        topic, correlation = message.response_topic, message.correlation
        refused = None
        if word not in self._handlers:
            allowed = nearest(word, verbs.permitted(self.allowed))
            refused = CommandRefusedError("unknown_verb", f"no command is called {_quoted(word)}", allowed)
        if correlation is not None and len(correlation) > CORRELATION_BYTES_MAX:
            size = f"correlation data of {len(correlation)} bytes, at most {CORRELATION_BYTES_MAX}"
            refused = CommandRefusedError("correlation", size, "send shorter correlation data; they are not repeated")
            correlation = None
        if topic is not None and not self._may_answer_to(topic):
            below = f"use a topic outside {self._base.rpartition('/')[0]}/, or below {self._base}/rsp/"
            refused = CommandRefusedError("response_topic", f"answers do not go to {_quoted(topic)}", below)
            topic = None
        return _Command(verb, message.payload, topic or f"{self._base}/rsp/{verb}", correlation, refused)

    def _may_answer_to(self, topic: str) -> bool:
        """Whether the topic is a valid response topic and not a topic of a daemon."""
        sound = topic and topic.isprintable() and len(topic.encode()) <= RESPONSE_TOPIC_BYTES_MAX
        sound = sound and topic.count("/") < RESPONSE_TOPIC_LEVELS_MAX
        if not sound or any(sign in topic for sign in "+#") or topic.startswith("$"):
            return False
        prefix = self._base.rpartition("/")[0]
        return topic.startswith(f"{self._base}/rsp/") or not f"{topic}/".startswith(f"{prefix}/")

    def _refuse_excess(self, command: _Command) -> None:
        """Answer some of a flood, but not each: a flood of answers would be no better."""
        if self._refusals.try_acquire():
            more = f"more than {AT_ONCE} commands at once, or {PER_SECOND:g} a second"
            self._refuse(command, "too_many", more, "send them more slowly; some get no answer at all")
            return
        self.counts["unanswered"] += 1
        if self._warnings.try_acquire():
            log.warning("commands come faster than %g a second: some are passed over", PER_SECOND)

    def _handle_next(self) -> None:
        if not self._waiting:  # closed meanwhile
            return
        command = self._waiting.popleft()
        if self._waiting:
            self._loop.call_soon(self._handle_next)
        with self._refusing(command):
            outcome = self._begin(command)
            if isinstance(outcome, verbs.Answer):
                self._answer(command, outcome)
            else:
                work = self._loop.create_task(outcome, name=f"command {command.verb}")
                self._work.add(work)
                work.add_done_callback(self._work.discard)
                finishing = self._loop.create_task(self._finish(command, work), name=f"answer to {command.verb}")
                self._finishing.add(finishing)
                finishing.add_done_callback(self._finishing.discard)

    def _begin(self, command: _Command) -> verbs.Answer | Coroutine[Any, Any, verbs.Answer]:
        if command.refused is not None:
            raise command.refused
        verb, handler = verbs.VERBS[command.verb], self._handlers[command.verb]
        if verb.changes and command.verb not in self.allowed:
            name = self._base.rpartition("/")[2]
            raise CommandRefusedError(
                "not_permitted",
                f"{command.verb} is not permitted",
                f'add "{command.verb}" to allow in [commands] of its configuration, then: resonatord reload {name}',
            )
        return handler(_request(verb, command.payload))

    async def _finish(self, command: _Command, work: asyncio.Task[verbs.Answer]) -> None:
        """Answer when the work is done, or when it takes too long; it keeps its place among those that wait."""
        await asyncio.wait({work}, timeout=self._deferred_s)
        if not work.done():
            late = f"not done within {self._deferred_s:g} s, and may still be done"
            self._refuse(command, "timeout", late, "read health or state before sending it again")
            await asyncio.wait({work})
            if not work.cancelled() and (error := work.exception()) is not None:
                log.warning("command %s, too late for an answer: %s", command.verb, error)
        elif work.cancelled():
            self.counts["unanswered"] += 1
        else:
            with self._refusing(command):
                self._answer(command, work.result())

    @contextmanager
    def _refusing(self, command: _Command) -> Iterator[None]:
        try:
            yield
        except CommandRefusedError as refused:
            self._refuse(command, refused.code, refused.message, refused.hint)
        except NotAddressedError:
            self.counts["unanswered"] += 1
        except Exception as error:  # a command of any sender must not end the daemon
            kind = (command.verb, type(error))
            if kind not in self._logged:
                self._logged.add(kind)
                log.error("command %s failed; further such failures are not logged", command.verb, exc_info=error)
            self._refuse(command, "failed", f"{command.verb} failed in the daemon", "see its log")

    def _answer(self, command: _Command, answer: verbs.Answer) -> None:
        answer = answer.model_copy(update={"id": _request_id(command.payload)})
        self._send(Outgoing(command.topic, answer.model_dump_json().encode(), command.correlation))
        self.counts["done"] += 1

    def _refuse(self, command: _Command, code: str, message: str, hint: str = "") -> None:
        problem = verbs.Problem(
            code=verbs.ErrorCode(code), message=message[:_TEXT_LENGTH_MAX], hint=hint[:_TEXT_LENGTH_MAX]
        )
        refusal = verbs.Refusal(verb=command.verb, id=_request_id(command.payload), error=problem)
        # In ASCII, which takes any text: a path may hold what UTF-8 does not.
        self._send(Outgoing(command.topic, json.dumps(refusal.model_dump()).encode(), command.correlation))
        self.counts[code] += 1


class _Identified(BaseModel):
    """A request of which only the `id` matters."""

    id: verbs.RequestId


def _request_id(payload: bytes) -> str | None:
    """Return the `id` of a request whatever else it has; None where there is none, or none that is sound."""
    try:
        return _Identified.model_validate_json(payload[: PAYLOAD_BYTES_MAX + 1], strict=True).id
    except ValidationError:
        return None


def _request(verb: verbs.Verb, payload: bytes) -> verbs.Request:
    if len(payload) > PAYLOAD_BYTES_MAX:
        size = f"payload of {len(payload)} bytes, at most {PAYLOAD_BYTES_MAX}"
        raise CommandRefusedError("payload", size, _SCHEMA)
    try:
        return verb.request.model_validate_json(payload)
    except ValidationError as error:
        findings = error.errors(include_url=False)[:_FINDINGS_MAX]
        sentences = "; ".join(_sentence(verb, found) for found in findings)
        hint = _SCHEMA if payload else "send {} for a command without fields"
        raise CommandRefusedError("payload", sentences, hint) from None


def _sentence(verb: verbs.Verb, error: ErrorDetails) -> str:
    where = ".".join(_key(key) if isinstance(key, str) else str(key) for key in error["loc"])
    match error["type"]:
        case "json_invalid":
            return f"the payload is no JSON: {error['ctx']['error']}"
        case "extra_forbidden":
            return f"{where}: unknown key; {nearest(str(error['loc'][-1]), list(verb.request.model_fields))}"
        case "missing":
            return f"{where}: missing; give a value"
        case _:
            message = error["msg"].removeprefix("Value error, ")
            message = message.replace("Input should be", "must be", 1).replace("String should", "must", 1)
            return f"{where or 'payload'}: got {_quoted(error['input'])}; {message}"


def _key(name: str) -> str:
    return name if _WORD.fullmatch(name) else _quoted(name)


def _quoted(value: object) -> str:
    """Return a value as JSON, which distinguishes texts from numbers, in ASCII and cut to a length."""
    text = json.dumps(value)
    return text if len(text) <= _SHOWN_LENGTH_MAX else f"{text[: _SHOWN_LENGTH_MAX - 3]}..."
