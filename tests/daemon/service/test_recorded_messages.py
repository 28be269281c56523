"""Which of the published messages a recording is handed, and as what."""

import json

import pytest
from command_stand_ins import messages
from jsonschema import validate

from resonator_daemon.board.recording.writer import Published
from resonator_daemon.daemon.service.recordings import RecordedMessages
from resonator_daemon.mqtt.topics import TOPICS


@pytest.mark.parametrize("include_messages", [True, False])
def test_states_are_recorded_and_what_is_measured_where_it_is_wanted(include_messages: bool) -> None:
    taken: list[Published] = []
    recorded = RecordedMessages(taken.append, include_messages=include_messages)
    published = messages()
    for path, message in published.items():
        recorded.record(TOPICS[path], message)
    measured = {"forces", "contacts", "contacts/event", "tones", "decoded/summary", "health"}
    assert {one.topic for one in taken if one.retained} == {"state/daemon", "state/link", "state/sensor", "info"}
    assert {one.topic for one in taken if not one.retained} == (measured if include_messages else set())
    for one in taken:
        validate(json.loads(one.payload), one.schema)
        assert one.utc_ns == published[one.topic].model_dump()["t_ns"]
