"""Commands, without a broker: checked, permitted, limited and answered; whatever comes, nothing escapes."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from mqtt_helpers import until

from resonator_daemon.mqtt.codec import Incoming, Outgoing
from resonator_daemon.mqtt.commands import (
    AT_ONCE,
    PAYLOAD_BYTES_MAX,
    REFUSALS_AT_ONCE,
    RESPONSE_TOPIC_BYTES_MAX,
    WAITING_MAX,
    CommandRefusedError,
    Commands,
    Handler,
)
from resonator_daemon.mqtt.verbs import Answer, Identify, IdentifyAnswer, Mark, MarkAnswer, Ping, Pong, Tare

BASE = "resonator/left"
NO_ANSWER_S = 1000.0  # a test that waits for it hangs


class Bench:
    """Commands with handlers that do nothing, a clock that stands still, and what was sent."""

    def __init__(self) -> None:
        self.sent: list[Outgoing] = []
        self.now_s = 0.0
        self.asked: list[Any] = []
        self.handlers: dict[str, Handler] = {"ping": self.ping, "mark": self.mark, "identify": self.identify}
        self.board: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.commands = self.make(allowed=("mark", "identify"))

    def make(self, *, allowed: tuple[str, ...] = (), base: str = BASE, deferred_s: float = NO_ANSWER_S) -> Commands:
        self.commands = Commands(
            base, self.handlers, allowed, self.sent.append, clock=lambda: self.now_s, deferred_s=deferred_s
        )
        return self.commands

    def ping(self, request: Ping) -> Pong:
        self.asked.append(request)
        return Pong(t_ns=2**60, daemon_boot_id="9f3c", uptime_s=float("nan"))

    def mark(self, request: Mark) -> MarkAnswer:
        self.asked.append(request)
        return MarkAnswer(t_ns=7)

    async def identify(self, request: Identify) -> IdentifyAnswer:
        self.asked.append(request)
        await self.board
        return IdentifyAnswer()

    @property
    def said(self) -> list[dict[str, Any]]:
        return [json.loads(answer.payload) for answer in self.sent]

    @property
    def codes(self) -> list[str]:
        return [said["error"]["code"] if not said["ok"] else "done" for said in self.said]

    async def settle(self) -> None:
        for _ in range(2 * WAITING_MAX):
            await asyncio.sleep(0)

    async def ask(self, *messages: Incoming) -> list[dict[str, Any]]:
        """Give messages and return all that was said since."""
        before = len(self.sent)
        for message in messages:
            self.commands.receive(message)
        await self.settle()
        return self.said[before:]


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    bench = Bench()
    yield bench
    await bench.commands.close()


def incoming(
    verb: str = "ping",
    payload: bytes = b"{}",
    response_topic: str | None = None,
    *,
    retained: bool = False,
    correlation: bytes | None = None,
) -> Incoming:
    return Incoming(f"{BASE}/cmd/{verb}", payload, retained, response_topic, correlation)


@pytest.mark.parametrize(
    "payload",
    [
        b'{"txt": "a"}',
        b'{"text": 7}',
        b"",
        b"{",
        b"\xff\x00",
        '{"text": "a"}'.encode("utf-16"),
        b"[]",
        b'"text"',
        b'{"text": NaN}',
        b'{"text": "\\ud800"}',
        b'{"text": ' + b"[" * 8000 + b"]" * 8000 + b"}",
        b'{"text": ' + b"7" * 8000 + b"}",
        b'{"text": "a\\nb"}',
        b'{"text": "a", "at\\u0000": 1}',
        b'{"text": "' + b"x" * 300 + b'"}',
        b'{"text": "a"}' + b" " * PAYLOAD_BYTES_MAX,
    ],
    ids=repr,
)
async def test_a_request_that_is_not_the_verbs_is_refused(bench: Bench, payload: bytes) -> None:
    await bench.ask(incoming("mark", payload))
    assert bench.codes == ["payload"]
    assert bench.asked == []


async def test_a_refusal_has_every_finding(bench: Bench) -> None:
    (said,) = await bench.ask(incoming("mark", b'{"txt": "a"}'))
    assert said["error"]["message"].count(";") == 4  # two keys with their remedies, one of them a suggestion


@pytest.mark.parametrize("id_", ["drop-1", "é" * 64])
async def test_each_answer_repeats_the_id_of_its_request(bench: Bench, id_: str) -> None:
    asked = json.dumps({"id": id_}).encode()
    wrong = json.dumps({"id": id_, "more": 1}).encode()
    bench.board.set_exception(CommandRefusedError("not_located", "no board", "plug it in"))
    bench.make(allowed=("identify",))
    answers = await bench.ask(
        incoming(payload=asked),
        incoming(payload=wrong),
        *(incoming(verb, asked) for verb in ("mark", "fly", "identify")),
    )
    assert bench.codes == ["done", "payload", "not_permitted", "unknown_verb", "not_located"]
    assert answers[2]["error"]["hint"].endswith("resonatord reload left")
    assert [answer["id"] for answer in answers] == [id_] * 5
    assert answers[-1]["error"] == {"code": "not_located", "message": "no board", "hint": "plug it in"}
    bench.sent.clear()
    await bench.ask(*[incoming(payload=asked)] * AT_ONCE)
    assert "too_many" in bench.codes
    assert {answer["id"] for answer in bench.said} == {id_}


FORMS = ["7", "1.5", "true", '""', '"' + "x" * 65 + '"', '"a\\n"', "[1]"]


@pytest.mark.parametrize("payload", ["", "[]", '{"id": "1"', *(f'{{"id": {form}}}' for form in FORMS)])
async def test_an_id_that_cannot_be_read_is_refused_and_not_repeated(bench: Bench, payload: str) -> None:
    (said,) = await bench.ask(incoming(payload=payload.encode()))
    assert (said["id"], said["error"]["code"], bench.asked) == (None, "payload", [])


async def test_correlation_data_that_are_too_long_are_refused(bench: Bench) -> None:
    (said,) = await bench.ask(incoming(correlation=b"x" * 30_000))
    assert (said["error"]["code"], bench.sent[0].correlation, bench.asked) == ("correlation", None, [])


@pytest.mark.parametrize("verb", ["fly", "x" * 200, "#", "a/b", "é", "\ud800", ""])
async def test_a_strange_verb_does_not_get_into_topics(bench: Bench, verb: str) -> None:
    (said,) = await bench.ask(incoming(verb))
    assert bench.sent[0].topic == f"{BASE}/rsp/unknown"
    assert (said["verb"], said["error"]["code"]) == ("unknown", "unknown_verb")


@pytest.mark.parametrize(
    "topic",
    [
        f"{BASE}/state/daemon", "resonator/right/cmd/tare", f"{BASE}/rsp", "a/+/b", "$SYS/broker", "", "a\x00b",
        "a" * (RESPONSE_TOPIC_BYTES_MAX + 1), "\ud800", "/".join(["a"] * 101)
    ],
)  # fmt: skip
async def test_answers_do_not_go_where_a_daemons_word_is_believed(bench: Bench, topic: str) -> None:
    (said,) = await bench.ask(incoming(response_topic=topic))
    assert bench.sent[0].topic == f"{BASE}/rsp/ping"
    assert said["error"]["code"] == "response_topic"
    assert said["error"]["hint"] == f"use a topic outside resonator/, or below {BASE}/rsp/"
    assert len(bench.sent[0].payload) < 1000
    assert bench.asked == []


async def test_a_prefix_of_many_levels_is_the_daemons_own_as_a_whole(bench: Bench) -> None:
    bench.make(base="site/hall/left")
    topic = "site/hall/left/cmd/ping"
    for response_topic in ("site/hall/right/state/daemon", "site/other"):
        bench.commands.receive(Incoming(topic, b"{}", False, response_topic, None))
    await bench.settle()
    assert [answer.topic for answer in bench.sent] == ["site/hall/left/rsp/ping", "site/other"]
    assert bench.codes == ["response_topic", "done"]


@pytest.mark.parametrize("topic", ["robot/answers", f"{BASE}/rsp/ping/17", "resonators/left", "/".join(["a"] * 100)])
async def test_answers_go_elsewhere_and_below_the_own_rsp(bench: Bench, topic: str) -> None:
    (said,) = await bench.ask(incoming(response_topic=topic, correlation=b"17"))
    assert (bench.sent[0].topic, bench.sent[0].correlation) == (topic, b"17")
    assert said["ok"] is True


async def test_a_retained_command_is_nobodys(bench: Bench) -> None:
    assert await bench.ask(incoming(retained=True)) == []
    assert bench.asked == []


async def test_commands_are_done_one_with_each_turn_of_the_loop(bench: Bench) -> None:
    turns: list[int] = []

    def count() -> None:
        turns.append(len(bench.asked))
        if len(turns) < 6:
            asyncio.get_running_loop().call_soon(count)

    for _ in range(4):
        bench.commands.receive(incoming())
    count()
    await bench.settle()
    assert turns == [0, 1, 2, 3, 4, 4]


async def test_a_flood_is_refused_and_the_refusals_are_few(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    flood = [incoming()] * (AT_ONCE + 100)
    await bench.ask(*flood)
    assert sorted(bench.codes) == ["done"] * AT_ONCE + ["too_many"] * REFUSALS_AT_ONCE
    assert bench.commands.counts == {
        "done": AT_ONCE,
        "too_many": REFUSALS_AT_ONCE,
        "unanswered": 100 - REFUSALS_AT_ONCE,
    }
    bench.now_s += 1.0
    bench.sent.clear()
    await bench.ask(*flood)
    assert sorted(bench.codes) == ["done"] * 10 + ["too_many"]
    bench.now_s += 1000.0
    bench.sent.clear()
    await bench.ask(*flood)
    assert len(bench.sent) == AT_ONCE + REFUSALS_AT_ONCE  # no more at once, however long it was quiet
    assert [record.getMessage() for record in caplog.records] == [
        "commands come faster than 10 a second: some are passed over"
    ] * 2  # once a minute at most


async def test_a_deferred_answer_comes_when_it_is_there_and_holds_nobody_up(bench: Bench) -> None:
    asked = incoming("identify", response_topic="robot/answers", correlation=b"1")
    said = await bench.ask(asked, incoming())
    assert [each["verb"] for each in said] == ["ping"]
    bench.board.set_result(None)
    await bench.settle()
    assert bench.said[1:] == [{"verb": "identify", "ok": True, "id": None}]
    assert (bench.sent[1].topic, bench.sent[1].correlation) == ("robot/answers", b"1")


async def test_what_takes_too_long_is_answered_once_and_left_to_end(bench: Bench) -> None:
    bench.make(allowed=("identify",), deferred_s=0.0)
    await bench.ask(incoming("identify"))
    await until(lambda: bool(bench.sent))
    assert bench.codes == ["timeout"]
    assert "may still be done" in bench.said[0]["error"]["message"]
    bench.board.set_result(None)
    await bench.settle()
    assert bench.codes == ["timeout"]
    assert not bench.board.cancelled()


async def test_those_that_wait_are_bounded_also_when_their_answers_are_late(bench: Bench) -> None:
    for _ in range(WAITING_MAX + 1):
        bench.now_s += 1.0
        await bench.ask(incoming("identify"))
    assert bench.codes == ["busy"]
    assert len(bench.asked) == WAITING_MAX
    bench.board.set_result(None)
    await bench.settle()
    assert bench.codes == ["busy"] + ["done"] * WAITING_MAX
    await bench.ask(incoming())  # and there is room again
    assert bench.codes[-1] == "done"


async def test_nothing_is_left_after_close(bench: Bench) -> None:
    await bench.ask(incoming("identify"))
    bench.commands.receive(incoming())
    others = asyncio.all_tasks() - {asyncio.current_task()}
    assert any("identify" in task.get_name() for task in others)
    defects: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: defects.append(context))
    await bench.commands.close()
    assert not any("identify" in task.get_name() for task in asyncio.all_tasks())
    await bench.settle()
    assert bench.sent == defects == []
    assert bench.board.cancelled()
    assert bench.commands.counts == {"unanswered": 2}


def failing(error: Exception) -> Callable[[Tare], Answer]:
    def handler(_: Tare) -> Answer:
        raise error

    return handler


async def test_a_failing_handler_is_logged_once(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.handlers["ping"] = failing(ZeroDivisionError("by zero"))
    for _ in range(3):
        await bench.ask(incoming())
    assert bench.codes == ["failed"] * 3
    assert bench.said[0]["error"]["message"] == "ping failed in the daemon"  # its own words may be nobody's business
    (record,) = caplog.records
    assert record.exc_info[0] is ZeroDivisionError
    bench.handlers["ping"] = failing(KeyError("other"))
    await bench.ask(incoming())
    assert len(caplog.records) == 2
    bench.board.set_exception(TimeoutError("its own"))
    await bench.ask(incoming("identify"))
    assert bench.codes[-1] == "failed"


async def test_a_refusal_takes_any_text_and_is_bounded(bench: Bench) -> None:
    bench.handlers["ping"] = failing(CommandRefusedError("not_ready", "\udcff" * 10_000, "h" * 10_000))
    await bench.ask(incoming())
    assert bench.codes == ["not_ready"]
    assert len(bench.sent[0].payload) < 10_000
