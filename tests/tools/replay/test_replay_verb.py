"""`resonatord replay` as a user meets it: to a broker, to a file, a part of a recording, and what cannot be played."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from brokers import Amqtt, Mosquitto
from command_line import exit_code
from commanded import commanded, state
from corpus_cases import CORPUS, read_expected
from observer import Observer, observe

from resonator_daemon.commands import main
from resonator_daemon.mqtt.topics import STATE_DAEMON

TOUCHES = CORPUS / "touches" / "recording.mcap"
COUNTS = read_expected(TOUCHES.parent).summary["messages"]


def replay(*arguments: object) -> int:
    return main(["replay", *map(str, arguments)])


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def counted(messages: list[dict[str, Any]]) -> dict[str, int]:
    topics = [message["topic"] for message in messages]
    return {topic: topics.count(topic) for topic in dict.fromkeys(topics)}


async def replay_to(capsys: pytest.CaptureFixture[str], url: str, *arguments: object) -> dict[str, Any]:
    """Run the verb in a thread, as its event loop is its own; return what it printed."""
    code = await asyncio.to_thread(replay, TOUCHES, "--url", url, "--json", *arguments)
    printed = capsys.readouterr()
    result: dict[str, Any] = json.loads(printed.out)
    return result | {"code": code, "stderr": printed.err}


def heard_of(heard: Observer, name: str, path: str) -> list[Any]:
    return heard.payloads(f"resonator/{name}/{path}")


def test_all_messages_go_to_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "run.jsonl"
    assert replay(TOUCHES, "--to", output, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["verb"], result["ok"], result["messages"]) == ("replay", True, COUNTS)
    assert (result["differences"], result["damage"]) == (0, None)
    assert result["seconds"] == pytest.approx(4.2, abs=0.3)
    assert counted(lines(output)) == COUNTS
    assert lines(output)[-1]["payload"]["daemon_boot_id"] == "0123456789abcdef"


def test_a_part_begins_with_the_states_that_held(tmp_path: Path) -> None:
    whole, part = tmp_path / "whole.jsonl", tmp_path / "part.jsonl"
    assert replay(TOUCHES, "--to", whole) == 0
    assert replay(TOUCHES, "--to", part, "--from", "half time", "--until", 3) == 0
    before, within = lines(whole), lines(part)
    held = [message for message in within if message["topic"] in ("state/link", "state/sensor", "info")]
    assert [message["topic"] for message in within[:3]] == [message["topic"] for message in held]
    assert {message["payload"].get("state") for message in held} == {"online", None}
    streamed = within[3:]
    start = before.index(streamed[0])
    assert before[start : start + len(streamed)] == streamed
    assert 0.3 < counted(streamed)["forces"] / COUNTS["forces"] * 4.2 < 1.2


async def test_a_replay_at_a_broker_is_like_its_daemon_but_says_that_it_is_none(
    broker: Mosquitto | Amqtt, capsys: pytest.CaptureFixture[str]
) -> None:
    async with observe(broker.url) as heard:
        result = await replay_to(capsys, broker.url, "--speed", "max")
        last = await heard.until_last("resonator/left-index/state/daemon", state="offline")
        assert (result["code"], result["name"], result["messages"]) == (0, "left-index", COUNTS), result
        assert result["dropped"] == {}
        for path, count in COUNTS.items():
            await heard.until_count(f"resonator/left-index/{path}", count)
            assert [payload["seq"] for payload in heard_of(heard, "left-index", path)] == list(range(count))
    assert last["reason"] == "replaying recording.mcap: over"
    states = heard_of(heard, "left-index", "state/daemon")
    assert any((state["state"], state["reason"]) == ("online", "replaying recording.mcap") for state in states)
    ids = {payload["daemon_boot_id"] for path in COUNTS for payload in heard_of(heard, "left-index", path)}
    assert ids == {last["daemon_boot_id"]} != {"0123456789abcdef"}


async def test_a_replay_needs_a_name_of_its_own(mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]) -> None:
    async with commanded(mosquitto.url, {}, name="left-index") as live, observe(mosquitto.url) as heard:
        live.publisher.publish(live.base, STATE_DAEMON, state("online", "measuring"))
        await heard.until_last("resonator/left-index/state/daemon", state="online")
        refused = await replay_to(capsys, mosquitto.url)
        assert (refused["code"], refused["error"]["code"]) == (69, "name_taken")
        assert len(heard_of(heard, "left-index", "state/daemon")) == 1
        result = await replay_to(capsys, mosquitto.url, "--name", "again", "--speed", "max")
        assert result["code"] == 0
        await heard.until_last("resonator/again/state/daemon", state="offline")


@pytest.mark.parametrize("case", ["cut-off", "bit-flipped"])
def test_a_damaged_file_is_played_up_to_there(case: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert replay(CORPUS / case / "recording.mcap", "--to", "-") == 1
    printed = capsys.readouterr()
    assert printed.out.count('"topic":"forces"') >= 30
    assert printed.err.splitlines()[-1].endswith("; resonatord repair FILE copies all complete parts")


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("one.mcap", "two.mcap"),
        ("one.mcap", "--to", "-", "--json"),
        ("one.mcap", "--speed", "0"),
    ],
)
def test_what_does_not_go_together_is_a_matter_of_usage(arguments: tuple[str, ...]) -> None:
    assert exit_code("replay", *arguments) == 2
