"""Recordings that the configuration starts: when, where, with which limits; and which messages are in them."""

import json
import logging
from pathlib import Path
from typing import Any

import pytest
from command_stand_ins import configured
from example_messages import example
from jsonschema import validate

from resonator_daemon.board.config import Config
from resonator_daemon.board.config.values import load_plate_text, load_settings_text
from resonator_daemon.board.links.carriers.recording import RecordingTarget
from resonator_daemon.board.recording.file_series import Series
from resonator_daemon.board.recording.reader import Origin, open_recording
from resonator_daemon.board.recording.switch import RecordingSwitch
from resonator_daemon.board.recording.writer import Published
from resonator_daemon.daemon.service.recordings import RecordedMessages, RecordingCommands, recording_info
from resonator_daemon.mqtt.commands import CommandRefusedError
from resonator_daemon.mqtt.topics import JSON, TOPICS
from resonator_daemon.mqtt.verbs import StartRecording, StopRecording


def config(directory: Path, **recording: Any) -> Config:
    given = configured(directory)
    return given.model_copy(update={"recording": given.recording.model_copy(update=recording)})


class Seen:
    """In place of a switch: what it would be started with."""

    def __init__(self) -> None:
        self.started: list[Series] = []
        self.current = None

    def start(self, place: Series, _origin: Origin) -> None:
        self.started.append(place)


async def test_a_recording_without_end_begins_once_and_ends_where_it_is_not_wanted_any_more(tmp_path: Path) -> None:
    switch = RecordingSwitch()
    endless = config(tmp_path, autostart=True)
    commands = RecordingCommands(endless, "left", switch, daemon_boot_id="b", config_sha256="1")
    await commands.keep_recording()
    now = switch.current
    await commands.keep_recording()
    assert (await commands.start(StartRecording())).was_active
    assert switch.current.path == now.path
    await commands.adopt(config(tmp_path), "2")
    assert switch.current is None
    await commands.adopt(config(tmp_path), "3")
    assert switch.current is None
    await commands.adopt(endless, "4")
    last = switch.current.path
    await commands.stop(StopRecording())
    with open_recording(str(last)) as it:
        assert {key: it.header[key] for key in ("name", "daemon_boot_id", "config_sha256")} == {
            "name": "left",
            "daemon_boot_id": "b",
            "config_sha256": "4",
        }
        assert load_plate_text(it.plate_text, last).model_dump_json() == endless.plate.model_dump_json()
        settings = load_settings_text(it.settings_text, last)
        assert (settings.measurement, settings.decoding) == (endless.measurement, endless.decoding)


@pytest.mark.parametrize("config_began_before", [False, True])
async def test_what_a_command_began_goes_on_where_the_configuration_stops_recording(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, config_began_before: bool
) -> None:
    caplog.set_level(logging.INFO)
    switch = RecordingSwitch()
    endless = config(tmp_path, autostart=True)
    commands = RecordingCommands(endless if config_began_before else config(tmp_path), "left", switch)
    await commands.keep_recording()
    await commands.stop(StopRecording())
    began = await commands.start(StartRecording(label="mine"))
    await commands.adopt(endless, None)
    await commands.adopt(config(tmp_path), None)
    assert str(switch.current.path) == began.file
    assert caplog.messages == []
    assert (await commands.stop(StopRecording())).was_active


async def test_a_replay_is_not_recorded(tmp_path: Path) -> None:
    switch = RecordingSwitch()
    replaying = config(tmp_path, autostart=True).model_copy(update={"link": RecordingTarget("run.mcap")})
    await RecordingCommands(replaying, "left", switch).keep_recording()
    assert switch.current is None


async def test_limits_are_those_of_the_configuration(tmp_path: Path) -> None:
    seen = Seen()
    limits = {"file_max_mb": 2.5, "file_max_minutes": 0.5, "max_total_mb": 7.0, "min_free_mb": 3.0, "autostart": True}
    await RecordingCommands(config(tmp_path, **limits), "left", seen).keep_recording()  # type: ignore[arg-type]
    assert seen.started == [
        Series(
            tmp_path,
            "left",
            file_max_bytes=2_500_000,
            file_max_ns=30 * 10**9,
            max_total_bytes=7_000_000,
            min_free_bytes=3_000_000,
            resumes=True,
            begins_late=True,
        )
    ]


async def test_counts_go_on_when_a_recording_ends_and_another_begins(tmp_path: Path) -> None:
    switch = RecordingSwitch()
    commands = RecordingCommands(config(tmp_path), "left", switch)
    idle = {"file": None, "since_t_ns": None, "failure": None, "file_bytes": 0}
    none = {"files_removed": 0, "events_missing": 0, "messages_missing": 0}
    assert json.loads(recording_info(switch).model_dump_json()) == {**idle, **none, "files": 0, "messages": 0}
    for number in (1, 2):
        began = await commands.start(StartRecording())
        told = recording_info(switch)
        assert (told.file, told.since_t_ns, told.files) == (began.file, began.since_t_ns, number)
        switch.publish(Published("forces", number, b"{}", {"title": "Forces", "type": "object"}, retained=False))
        await commands.stop(StopRecording())
        told = recording_info(switch)
        assert json.loads(told.model_dump_json()) == {**idle, **none, "files": number, "messages": number}


@pytest.mark.parametrize("include_messages", [True, False])
def test_states_are_recorded_and_what_is_measured_where_it_is_wanted(include_messages: bool) -> None:
    taken: list[Published] = []
    recorded = RecordedMessages(taken.append, include_messages=include_messages)
    published = {path: example(topic.payload) for path, topic in TOPICS.items() if topic.content_type == JSON}
    for path, message in published.items():
        recorded.record(TOPICS[path], message)
    measured = {"forces", "contacts", "contacts/event", "tones", "decoded/summary", "health"}
    assert {one.topic for one in taken if one.retained} == {"state/daemon", "state/link", "state/sensor", "info"}
    assert {one.topic for one in taken if not one.retained} == (measured if include_messages else set())
    for one in taken:
        validate(json.loads(one.payload), one.schema)
        assert one.utc_ns == published[one.topic].model_dump()["t_ns"]


@pytest.mark.parametrize("autostart", [False, True])
async def test_a_command_that_finds_no_room_is_refused_and_records_nothing(tmp_path: Path, *, autostart: bool) -> None:
    switch = RecordingSwitch()
    commands = RecordingCommands(config(tmp_path, autostart=autostart, min_free_mb=1e12), "left", switch)
    await commands.keep_recording()
    info = recording_info(switch)
    assert (info.file, info.failure_code) == (None, "disk_full" if autostart else None)
    await commands.stop(StopRecording())
    with pytest.raises(CommandRefusedError) as refused:
        await commands.start(StartRecording())
    assert (refused.value.code, switch.current, list(tmp_path.iterdir())) == ("recording_failed", None, [])
