"""What the daemon does for each command, on stand-ins of its parts."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from command_stand_ins import RECORDING_NAME, StandIn, configured, handlers_on, messages

from resonator_daemon.daemon import command_handlers
from resonator_daemon.daemon.command_handlers import CommandHandlers
from resonator_daemon.daemon.recording_commands import RecordingCommands
from resonator_daemon.publishing.commands import CommandRefusedError
from resonator_daemon.publishing.verbs import VERBS, Answer
from resonator_daemon.recording.switch import RecordingNow, RecordingSwitch


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
        assert (said.pop("verb"), said.pop("ok")) == (verb, True)
        return said

    async def refusal(self, verb: str, **request: Any) -> CommandRefusedError:
        with pytest.raises(CommandRefusedError) as refused:
            await self.ask(verb, **request)
        return refused.value


@pytest.fixture
async def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


async def test_every_verb_has_a_handler(bench: Bench) -> None:
    assert bench.handlers.by_verb.keys() == VERBS.keys()


async def test_a_snapshot_has_the_last_messages_as_they_were(bench: Bench) -> None:
    said = await bench.ask("snapshot")
    last = messages()
    assert said["messages"] == {path: json.loads(message.model_dump_json()) for path, message in last.items()}
    assert said["messages"]["forces"]["sites"]  # whole messages, not what they have in common
    assert said["left_out"] == []
    said = await bench.ask("snapshot", topics=["info", "state/link", "info"])
    assert list(said["messages"]) == ["info", "state/link"]
    assert (await bench.ask("snapshot", topics=[]))["messages"] == {}
    assert bench.daemon.acts == []


async def test_a_snapshot_is_bounded(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    info = len(messages()["info"].model_dump_json())
    monkeypatch.setattr(command_handlers, "SNAPSHOT_BYTES_MAX", info)
    said = await bench.ask("snapshot", topics=["info", "state/link"])
    assert (list(said["messages"]), said["left_out"]) == (["info"], ["state/link"])
    assert (await bench.ask("snapshot", topics=["info", "info"]))["left_out"] == []
    said = await bench.ask("snapshot", topics=["state/link", "info"])
    assert (list(said["messages"]), said["left_out"]) == (["state/link"], ["info"])


async def test_tare(bench: Bench) -> None:
    said = await bench.ask("tare")
    assert said == {"did": "the present readings count as untouched", "common_mode": [1e-6, None, None, None]}
    bench.daemon.touched = "site 7 is touched"
    refused = await bench.refusal("tare")
    assert (refused.code, refused.message) == ("not_untouched", "site 7 is touched")
    bench.daemon.counts = False
    assert (await bench.refusal("tare")).code == "not_ready"
    assert bench.daemon.acts == [("tare",), ("tare",)]


async def test_a_window_is_set_in_frames_and_told(bench: Bench) -> None:
    assert await bench.ask("set_window", window_ms=20, step_ms=10) == {"window_s": 0.02, "step_s": 0.01}
    assert await bench.ask("set_window", window_ms=16) == {"window_s": 0.016, "step_s": 0.01}  # the step as it was
    assert bench.daemon.acts == [
        ("measure_over", 20.0, 10.0),
        ("measure_over", 16.0, 10.0),
    ]


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        ({"window_ms": 4}, "step_ms: got 5; must be at most window_ms = 4, or counts would be lost between windows"),
        ({"window_ms": 10.5, "step_ms": 5}, "window_ms: got 10.5; must be a whole number of frame periods of 1 ms"),
        ({"window_ms": 1e-300, "step_ms": 5e-324}, "window_ms: got 1e-300; must be a whole number of frame periods"),
    ],
)
async def test_a_window_must_fit_as_in_the_configuration(
    bench: Bench, request_: dict[str, float], sentence: str
) -> None:
    refused = await bench.refusal("set_window", **request_)
    assert refused.code == "window"
    assert sentence in refused.message
    assert bench.daemon.acts == []


async def test_rates_are_set_told_and_taken_back(bench: Bench) -> None:
    assert await bench.ask("set_rate", topic="forces", rate_hz=20) == {"topic": "forces", "rate_hz": 20.0}
    assert await bench.ask("set_rate", topic="contacts", rate_hz=5) == {"topic": "contacts", "rate_hz": 5.0}
    assert await bench.ask("set_rate", topic="forces", rate_hz=None) == {"topic": "forces", "rate_hz": None}
    assert bench.daemon.acts == [
        ("set_rate", "forces", 20.0, {"forces": 20.0}),
        ("set_rate", "contacts", 5.0, {"forces": 20.0, "contacts": 5.0}),
        ("set_rate", "forces", None, {"contacts": 5.0}),
    ]


async def test_a_stream_that_is_not_published_has_no_rate(bench: Bench) -> None:
    refused = await bench.refusal("set_rate", topic="decoded", rate_hz=5)
    assert (refused.code, refused.hint) == ("not_published", "streams: forces, contacts")
    assert bench.daemon.acts == []


async def test_a_recording_from_start_to_stop(bench: Bench) -> None:
    before = datetime.now(UTC)
    started = await bench.ask("start_recording", label="drop-1")
    path = Path(started["file"])
    assert (path.parent, started["since_t_ns"], started["already"]) == (bench.directory, "1789000000000000000", False)
    assert RECORDING_NAME.fullmatch(path.name)
    assert path.name.endswith("Z-drop-1.mcap")
    told = datetime.strptime(path.name[5:24], "%Y%m%dT%H%M%S.%f").replace(tzinfo=UTC)
    assert -0.001 <= (told - before).total_seconds() < 60
    assert bench.directory.is_dir()
    assert await bench.ask("mark", text="drop") == {"t_ns": "1789000000000000001"}
    stopped = await bench.ask("stop_recording")
    summary = {"file": str(path), "files": 1, "all_bytes": 1000, "events": 20, "events_missing": 1, "duration_s": 2.5}
    assert stopped == {"recording": {**summary, "failure": None}, "already": False}
    assert [act[0] for act in bench.daemon.acts] == ["start", "mark", "stop"]


async def test_recordings_may_be_asked_for_again(bench: Bench) -> None:
    assert await bench.ask("stop_recording") == {"recording": None, "already": True}
    first = await bench.ask("start_recording", label="a")
    for request in ({"label": "a"}, {}):
        assert await bench.ask("start_recording", **request) == {**first, "already": True}
    refused = await bench.refusal("start_recording", label="b")
    assert refused.code == "recording"
    assert first["file"] in refused.message
    stopped = await bench.ask("stop_recording")
    assert await bench.ask("stop_recording") == {**stopped, "already": True}
    second = await bench.ask("start_recording")
    assert second["already"] is False
    refused = await bench.refusal("start_recording", label="a")  # the one that runs has no label
    assert refused.code == "recording"


async def test_a_disk_that_takes_nothing_is_said(bench: Bench) -> None:
    bench.daemon.disk_problem = "No space left on device"
    refused = await bench.refusal("start_recording")
    assert refused.code == "recording_failed"
    assert "No space left on device" in refused.message
    assert "directory in [recording]" in refused.hint


async def test_a_recording_that_has_failed_is_not_taken_for_one_that_runs(bench: Bench) -> None:
    await bench.ask("start_recording")
    assert bench.daemon.current is not None
    bench.daemon.current = RecordingNow(bench.daemon.current.path, 1, "disk full")
    for verb, request in (("start_recording", {}), ("mark", {"text": "a"})):
        refused = await bench.refusal(verb, **request)
        assert (refused.code, refused.hint) == ("recording_failed", "send stop_recording, then start_recording")
        assert "disk full" in refused.message
    assert (await bench.ask("stop_recording"))["recording"]["failure"] == "disk full"
    assert (await bench.ask("start_recording"))["already"] is False


async def test_a_real_file_is_written(tmp_path: Path) -> None:
    switch = RecordingSwitch()
    recording = RecordingCommands(configured(tmp_path / "\udcff"), "é..left", switch)
    started = await recording.start(VERBS["start_recording"].request())
    (path,) = (tmp_path / "\udcff").iterdir()
    assert path.name.startswith("é..left-")
    assert "/?/" in json.loads(started.model_dump_json())["file"]
    stopped = await recording.stop(VERBS["stop_recording"].request())
    assert stopped.recording is not None
    assert stopped.recording.all_bytes == path.stat().st_size > 0
