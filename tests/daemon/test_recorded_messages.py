"""Which of the published messages a recording is handed, and as what."""

import json
from collections.abc import Mapping
from typing import Any

import pytest
from command_stand_ins import messages
from jsonschema import validate

from resonator_daemon.daemon.recorded_messages import RecordedMessages
from resonator_daemon.publishing.codec import Encoded
from resonator_daemon.publishing.topics import TOPICS


class Channels:
    def __init__(self) -> None:
        self.states: list[tuple[str, int]] = []
        self.messages: list[tuple[str, int]] = []

    def put_message(self, topic_path: str, t_ns: int, payload: bytes, json_schema: Mapping[str, Any]) -> None:
        validate(json.loads(payload), json_schema)
        self.messages.append((topic_path, t_ns))

    def put_state(self, topic_path: str, t_ns: int, payload: bytes, json_schema: Mapping[str, Any]) -> None:
        validate(json.loads(payload), json_schema)
        self.states.append((topic_path, t_ns))


@pytest.mark.parametrize("derived", [True, False])
def test_states_are_recorded_and_what_is_measured_where_it_is_wanted(derived: bool) -> None:
    channels = Channels()
    recorded = RecordedMessages(channels, derived=derived)
    published = messages()
    for path, message in published.items():
        recorded.record(TOPICS[path], message)
    assert {topic for topic, _ in channels.states} == {"state/daemon", "state/link", "state/sensor", "info"}
    measured = {"forces", "contacts", "contacts/event", "decoded/summary", "health"}
    assert {topic for topic, _ in channels.messages} == (measured if derived else set())
    assert all(t_ns == published[topic].model_dump()["t_ns"] for topic, t_ns in channels.states + channels.messages)


def test_what_is_wanted_may_change() -> None:
    channels = Channels()
    recorded = RecordedMessages(channels, derived=False)
    recorded.derived = True
    recorded.record(TOPICS["forces"], messages()["forces"])
    assert len(channels.messages) == 1


def test_what_is_encoded_already_is_recorded_as_it_is() -> None:
    channels = Channels()
    contacts = messages()["contacts"]
    recorded = RecordedMessages(channels, derived=True)
    recorded.record(TOPICS["contacts"], Encoded(contacts.model_dump_json().encode(), t_ns=7))
    recorded.record(TOPICS["decoded"], Encoded(b"arrays are not recorded", t_ns=7))
    assert channels.messages == [("contacts", 7)]
