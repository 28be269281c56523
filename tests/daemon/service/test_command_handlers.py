"""What the daemon does for each command, on stand-ins of its parts."""

import json
from pathlib import Path
from typing import Any

import pytest
from command_stand_ins import StandIn, configured, handlers_on
from example_messages import example

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.daemon.service.command_handlers import CommandHandlers
from resonator_daemon.mqtt.commands import CommandRefusedError
from resonator_daemon.mqtt.payloads import ContactEvent
from resonator_daemon.mqtt.topics import SIGNALS
from resonator_daemon.mqtt.verbs import VERBS, Answer


class Bench:
    def __init__(self, directory: Path, link: str = "tcp://127.0.0.1:5000") -> None:
        self.directory = directory / "recordings" / "deep"
        self.daemon = StandIn(self.directory)
        self.handlers: CommandHandlers = handlers_on(self.daemon, configured(self.directory, link))

    async def ask(self, verb: str, **request: Any) -> dict[str, Any]:
        """Ask as a subscriber; return the answer as it reads it."""
        outcome = self.handlers.by_verb[verb](VERBS[verb].request.model_validate(request))
        answer = outcome if isinstance(outcome, Answer) else await outcome
        assert type(answer) is VERBS[verb].answer
        said: dict[str, Any] = json.loads(answer.model_dump_json())
        assert (said.pop("verb"), said.pop("ok"), said.pop("id")) == (verb, True, None)
        return said

    async def refusal(self, verb: str, **request: Any) -> CommandRefusedError:
        with pytest.raises(CommandRefusedError) as refused:
            await self.ask(verb, **request)
        return refused.value


@pytest.fixture
async def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


async def test_stored_events(bench: Bench) -> None:
    for boot_id in ({}, {"daemon_boot_id": "9f3c"}):
        said = await bench.ask("events", after_seq=7.0, **boot_id)
        events = said.pop("events")
        assert [event["seq"] for event in events] == [8, 9]
        assert events[0] == json.loads(example(ContactEvent).model_dump_json()) | {"seq": 8}
        assert said.pop("next_daemon_boot_id") is None
        assert said == {"daemon_boot_id": "9f3c", "complete": True, "oldest_seq": 7, "newest_seq": 9}
    assert not (await bench.ask("events"))["complete"]
    assert (await bench.refusal("events", daemon_boot_id="other")).code == "unknown_boot"
    assert (await bench.refusal("events", daemon_boot_id="unreadable")).code == "storage_failed"


async def test_a_daemon_that_does_not_follow_contacts_has_no_events(bench: Bench) -> None:
    bench.daemon.streams = (SIGNALS,)
    assert (await bench.refusal("events")).code == "not_published"


async def test_tare(bench: Bench) -> None:
    said = await bench.ask("tare")
    assert said == {"message": "the present readings are the new zero", "common_mode": [1e-6, None, None, None]}
    bench.daemon.touched = "site 7 is touched"
    refused = await bench.refusal("tare")
    assert (refused.code, refused.message) == ("not_untouched", "site 7 is touched")
    bench.daemon.ready = False
    assert (await bench.refusal("tare")).code == "not_ready"
    assert bench.daemon.acts == [("tare",), ("tare",)]


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        ({"window_ms": 4}, "step_ms: got 5; must be at most window_ms = 4, or counts would be lost between windows"),
        ({"window_ms": 10.5, "step_ms": 5}, "window_ms: got 10.5; must be a whole number of frame periods of 1 ms"),
        ({"window_ms": 1e-300, "step_ms": 5e-324}, "window_ms: got 1e-300; must be a whole number of frame periods"),
    ],
)
async def test_a_window_must_fit_as_in_a_configuration(bench: Bench, request_: dict[str, float], sentence: str) -> None:
    refused = await bench.refusal("set_window", **request_)
    assert refused.code == "window"
    assert sentence in refused.message
    assert bench.daemon.acts == []


async def test_a_disk_that_takes_nothing_is_said(bench: Bench) -> None:
    bench.daemon.disk_problem = "No space left on device"
    refused = await bench.refusal("start_recording")
    assert refused.code == "recording_failed"
    assert "No space left on device" in refused.message
    assert "directory in [recording]" in refused.hint


async def test_a_recording_that_has_failed_is_not_taken_for_one_that_runs(bench: Bench) -> None:
    await bench.ask("start_recording")
    bench.daemon.current.failure = Reason(ReasonCode.DISK_FULL, "disk full")
    for verb, request in (("start_recording", {}), ("mark", {"text": "a"})):
        refused = await bench.refusal(verb, **request)
        assert (refused.code, refused.hint) == ("recording_failed", "send stop_recording, then start_recording")
        assert "disk full" in refused.message
    stopped = (await bench.ask("stop_recording"))["recording"]
    assert (stopped["failure_code"], stopped["failure"]) == ("disk_full", "disk full")
    assert (await bench.ask("start_recording"))["was_active"] is False
