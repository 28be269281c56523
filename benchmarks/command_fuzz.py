"""Random and mutated commands: whatever comes, it is refused or answered, and nothing else happens.

Run it with `make fuzz`, or `python benchmarks/command_fuzz.py [--inputs N] [--seed S]`: N inputs where nothing may be
changed, and a tenth of them where everything may. An input is a payload, a verb, a response topic and correlation data,
each sound, mutated or random, given to the real commands and handlers on stand-ins of the daemon's parts.
"""

import argparse
import asyncio
import json
import logging
import random
import tempfile
import time
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any, get_args

from command_stand_ins import BOOT_ID, StandIn, configured, handlers_on

from resonator_daemon.daemon.command_handlers import SNAPSHOT_BYTES_MAX
from resonator_daemon.publishing.commands import (
    AT_ONCE,
    CORRELATION_BYTES_MAX,
    RESPONSE_TOPIC_BYTES_MAX,
    WAITING_MAX,
    Commands,
)
from resonator_daemon.publishing.mqtt_messages import Incoming, Outgoing
from resonator_daemon.publishing.strict_json import PAYLOAD_BYTES_MAX
from resonator_daemon.publishing.verbs import ID_LENGTH_MAX, VERBS, ErrorCode

BASE = "resonator/left"
SOUND: tuple[tuple[str, dict[str, Any]], ...] = (
    ("ping", {}),
    ("ping", {"id": "question 7"}),
    ("health", {}),
    ("snapshot", {}),
    ("snapshot", {"topics": ["info", "forces"]}),
    ("events", {}),
    ("events", {"after_seq": 8, "daemon_boot_id": BOOT_ID}),
    ("tare", {}),
    ("start_recording", {}),
    ("start_recording", {"label": "drop-1"}),
    ("stop_recording", {}),
    ("mark", {"text": "touched"}),
    ("set_window", {"window_ms": 20}),
    ("set_window", {"window_ms": 10, "step_ms": 2}),
    ("set_rate", {"topic": "forces", "rate_hz": 20}),
    ("set_rate", {"topic": "contacts", "rate_hz": 3, "lease_s": 1}),
    ("identify", {}),
)
VERBS_TRIED = (*VERBS, "unknown", "TARE", "tare ", "../tare", "a/b", "#", "\ud800", "x" * 300, "")
TEXTS = ("", "forces", "../../etc/passwd", "a\x00b", "é\u202e", "\ud83d", "x" * 500, "drop-1", "info", "NaN", "%s{0}")
NUMBERS = (0, -1, 1, 10, 20, 0.5, 1e-320, 1e308, 2**63, 2**64, 10**19, True, False, None)
BROKEN = (b"NaN", b"1e999", b"1" * 5000, b"[" * 3000, b'{"a":' * 2000, b'{"label":"a","label":"b"}', b"\xef\xbb\xbf{}")
PIECES = (b'"', b"{", b"}", b"[", b"]", b",", b":", b"\\u0000", b"\xff", b"\\", b"null", b"NaN", b"1e999", b"9" * 30)
RESPONSE_TOPICS = (
    "robot/answers",
    f"{BASE}/rsp/tare/17",
    f"{BASE}/state/daemon",
    f"{BASE}/cmd/tare",
    "resonator/right/info",
    "resonator",
    "$SYS/broker",
    "a/#",
    "+",
    "",
    "a\x00b",
    "\ud800",
    "x" * 2000,
)
LATE_S = 30.0
ID_SHARE = 0.2  # of requests
QUICK_SHARE = 1e-3  # of commands, after which many come at once
TASKS_MAX = 3 * WAITING_MAX


class EscapedError(Exception):
    """Something happened that must not."""


class Inputs:
    """Makes commands at random."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._sound = tuple((verb, json.dumps(request).encode()) for verb, request in SOUND)

    def message(self) -> Incoming:
        draw = self._rng.random
        verb, payload = self._sound[int(draw() * len(self._sound))]
        choice = draw()
        if choice < 0.3:
            payload = self._mutated(payload)
        elif choice < 0.55:
            payload = json.dumps(self._request(verb)).encode()
        elif choice < 0.65:
            payload = json.dumps(self._tree(0)).encode()
        elif choice < 0.72:
            payload = self._rng.randbytes(int(draw() * 200))
        elif choice < 0.75:
            payload = BROKEN[int(draw() * len(BROKEN))]
        elif choice < 0.752:
            payload += bytes(PAYLOAD_BYTES_MAX)
        if draw() < 0.05:
            verb = VERBS_TRIED[int(draw() * len(VERBS_TRIED))]
        return Incoming(f"{BASE}/cmd/{verb}", payload, draw() < 0.03, self._response_topic(), self._correlation())

    def _mutated(self, raw: bytes) -> bytes:
        for _ in range(1 + int(self._rng.random() * 3)):
            at = int(self._rng.random() * (len(raw) + 1))
            match int(self._rng.random() * 5):
                case 0 if at < len(raw):
                    raw = raw[:at] + bytes((raw[at] ^ 1 << int(self._rng.random() * 8),)) + raw[at + 1 :]
                case 1:
                    raw = raw[:at] + raw[at + 1 + int(self._rng.random() * 8) :]
                case 2:
                    raw = raw[:at] + PIECES[int(self._rng.random() * len(PIECES))] + raw[at:]
                case 3:
                    raw = raw[:at]
                case _:
                    raw = raw[:at] + raw[: int(self._rng.random() * len(raw))]
        return raw

    def _request(self, verb: str) -> dict[str, Any]:
        """Return a request with the verb's own keys, mostly, and any values."""
        own = [key for key in VERBS[verb].request.model_fields if key != "id"]
        fields, known = (*own, *TEXTS), len(own) or 1
        keys = [fields[int(self._rng.random() ** 2 * 2 * known) % len(fields)] for _ in range(known)]
        keys += ["id"] * (self._rng.random() < ID_SHARE)
        return {key: self._value(1) for key in keys}

    def _tree(self, depth: int) -> Any:
        kind = self._rng.random()
        if depth < 12 and kind < 0.4:
            return {TEXTS[int(self._rng.random() * len(TEXTS))]: self._tree(depth + 1) for _ in range(2)}
        if depth < 12 and kind < 0.6:
            return [self._tree(depth + 1) for _ in range(int(self._rng.random() * 3))]
        return self._value(2)

    def _value(self, lists: int) -> Any:
        kind = self._rng.random()
        if kind < 0.4:
            return NUMBERS[int(self._rng.random() * len(NUMBERS))]
        if kind < 0.5:
            return self._rng.uniform(-5, 50)
        if kind < 0.9 or not lists:
            return TEXTS[int(self._rng.random() * len(TEXTS))]
        return [self._value(lists - 1) for _ in range(int(self._rng.random() * 20))]

    def _response_topic(self) -> str | None:
        choice = self._rng.random()
        if choice < 0.85:
            return None
        if choice < 0.97:
            return RESPONSE_TOPICS[int(self._rng.random() * len(RESPONSE_TOPICS))]
        return "".join(chr(int(self._rng.random() ** 4 * 0x110000)) for _ in range(int(self._rng.random() * 40)))

    def _correlation(self) -> bytes | None:
        choice = self._rng.random()
        return None if choice < 0.7 else self._rng.randbytes(int(choice**20 * 2 * CORRELATION_BYTES_MAX))


class Judge:
    """Looks at each answer; counts what they say."""

    def __init__(self, allowed: Collection[str]) -> None:
        self._allowed = allowed
        self.seen: Counter[str] = Counter()
        self.problems: list[str] = []

    def take(self, answer: Outgoing) -> None:
        topic = answer.topic
        own = topic.startswith(f"{BASE}/rsp/")
        if not topic or any(sign in topic for sign in "+#\0") or topic.startswith("$") or answer.retained:
            self.problems.append(f"an answer goes to {topic!a}")
        if not own and f"{topic}/".startswith("resonator/"):
            self.problems.append(f"an answer goes to {topic!a}, a daemon's own")
        if len(topic.encode()) > RESPONSE_TOPIC_BYTES_MAX or len(answer.correlation or b"") > CORRELATION_BYTES_MAX:
            self.problems.append("topic or correlation data are too long")
        if len(answer.payload) > 2 * SNAPSHOT_BYTES_MAX:
            self.problems.append(f"an answer has {len(answer.payload)} bytes")
        said = json.loads(answer.payload)
        if not isinstance(said["id"], str | None) or len(said["id"] or "") > ID_LENGTH_MAX:
            self.problems.append(f"an answer has the id {said['id']!a}")
        if said["ok"]:
            verb = VERBS[said["verb"]]
            if verb.changes and verb.name not in self._allowed:
                self.problems.append(f"{verb.name} is said to be done")
            self.seen[verb.name] += 1
        else:
            code = said["error"]["code"]
            if code not in get_args(ErrorCode) or code in ("failed", "timeout"):
                self.problems.append(f"an answer says {said['error']}")
            self.seen[code] += 1


async def fuzz(inputs: int, seed: int, allowed: Collection[str], directory: Path) -> Counter[str]:
    """Give so many inputs to commands; return what was answered, how often.

    Raises
    ------
    EscapedError
        An exception got out, something was changed that may not be, an answer is none or did not come.
    """
    rng = random.Random(seed)
    stand_in = StandIn(directory)
    judge = Judge(allowed)
    handlers = handlers_on(stand_in, configured(directory))
    now_s = 0.0
    asyncio.get_running_loop().set_exception_handler(lambda _, context: judge.problems.append(f"{context}"))
    commands = Commands(BASE, handlers.by_verb, allowed, judge.take, clock=lambda: now_s)
    make = Inputs(rng)
    taken = quick = 0
    for _ in range(inputs):
        message = make.message()
        taken += not message.retained  # nobody answers those
        commands.receive(message)
        if quick:  # some of these are too many
            quick -= 1
            continue
        now_s += 1.0
        quick = 2 * AT_ONCE if rng.random() < QUICK_SHARE else 0
        await asyncio.sleep(0)
        if commands.counts.total() < taken:
            await _answered(commands, taken, judge)
        if len(asyncio.all_tasks()) > TASKS_MAX:
            judge.problems.append(f"{len(asyncio.all_tasks())} tasks")
        if stand_in.acts and not allowed:
            judge.problems.append(f"without permission: {stand_in.acts}")
        if judge.problems:
            raise EscapedError(f"{message}: {judge.problems}")
        stand_in.acts.clear()
    await _answered(commands, taken, judge)
    await commands.close()
    return judge.seen


async def _answered(commands: Commands, taken: int, judge: Judge) -> None:
    """Wait until each command that was taken has become something."""
    try:
        async with asyncio.timeout(LATE_S):
            while commands.counts.total() < taken and not judge.problems:  # noqa: ASYNC110 - nobody says when
                await asyncio.sleep(0)
    except TimeoutError:
        raise EscapedError(f"{taken} commands were taken, {commands.counts} is what became of them") from None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10**6, help="where nothing may be changed (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)  # floods are part of it
    runs = (("nothing allowed", (), arguments.inputs), ("everything allowed", tuple(VERBS), arguments.inputs // 10))
    for name, allowed, inputs in runs:
        with tempfile.TemporaryDirectory() as directory:
            started = time.perf_counter()
            seen = asyncio.run(fuzz(inputs, arguments.seed, allowed, Path(directory)))
            seconds = time.perf_counter() - started
        print(f"{name}: {inputs} commands, {inputs / seconds:.0f} a second, nothing escaped")
        print("  " + ", ".join(f"{what} {count}" for what, count in sorted(seen.items())), flush=True)


if __name__ == "__main__":
    main()
