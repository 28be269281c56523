"""Messages that would be late are skipped and counted; states and events come all the same."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from resonator_daemon.board.recording.event_replay import Replay
from resonator_daemon.board.recording.reader import Mark, open_recording
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.link_state_machine import LinkStateMachine
from resonator_daemon.measure.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.mqtt.codec import decoded
from resonator_daemon.tools.replay.recorded_pipeline import open_replay

CORPUS = Path(__file__).parents[2] / "corpus"


class CountedDecoding:
    """Decoding that counts frames."""

    def __init__(self) -> None:
        self.offered = self.late = self.frames_late = 0

    def offer(self, _origin: object, _frame: object) -> None:
        self.offered += 1

    def skip_late(self) -> None:
        self.late += 1

    def interrupt(self, _reason: str) -> None:
        pass


def published(
    case: str, is_late: Callable[[Instant], bool], decoding: CountedDecoding | None = None
) -> list[tuple[str, Any]]:
    """Return topic and message of all that follows from a recording, but for decoding."""
    path = CORPUS / case / "recording.mcap"
    with open_replay(path) as replaying:
        config = replaying.config
    if decoding is None:  # late frames of a skin are not decoded
        config = config.model_copy(update={"decoding": config.decoding.model_copy(update={"method": "off"})})
    messages: list[tuple[str, Any]] = []

    pipeline = BoardPipeline(
        config,
        "9f3c",
        lambda topic, message: messages.append((topic.path, decoded(topic.payload, message))),
        is_late=is_late,
        make_decoding=lambda _settings, _client: decoding,
    )
    queue = FrameQueue(1 << 30, lambda: None, ())
    with open_recording(str(path)) as recording:
        replay = Replay(recording, LinkStateMachine(config.plate, queue, lambda _: None))
        for entry in recording.entries():
            if not isinstance(entry, Mark):
                replay.apply(entry)
            for arrival in queue.pop_all():
                pipeline.handle(arrival)
    return messages


@pytest.mark.parametrize(("case", "streams"), [("touches", {"forces", "contacts"}), ("skin", {"signals"})])
def test_of_late_windows_nothing_but_states_and_events_comes(case: str, streams: set[str]) -> None:
    answers = iter(range(10_000))
    every = published(case, lambda _: False)
    third = published(case, lambda _: next(answers) % 3 != 2)

    def of(messages: list[tuple[str, Any]], topics: set[str]) -> list[dict[str, Any]]:
        return [message.model_dump(exclude={"lost"}) for topic, message in messages if topic in topics]

    kept = {"contacts/event", "state/sensor", "state/link", "info"}
    assert str(of(every, kept)) == str(of(third, kept))
    for topic in streams:
        assert str(of(third, {topic})) == str(of(every, {topic})[2::3])
    last = [message.lost.skipped_late for topic, message in third if topic in streams][-1]
    assert last == 2 * len(of(third, streams)) + len(of(every, {"tones"})) - len(of(third, {"tones"}))


def test_frames_of_a_skin_are_decoded_or_counted_as_late() -> None:
    answers = iter(range(10_000))
    every, third = CountedDecoding(), CountedDecoding()
    published("skin", lambda _: False, every)
    messages = published("skin", lambda _: next(answers) % 3 != 2, third)
    assert third.offered == sum(topic == "signals" and message.status == "ok" for topic, message in messages) > 0
    assert third.offered + third.late == every.offered
    assert third.late > every.late == 0
