"""A recording from its bytes to its messages, one event after the other, without a clock or a second thread."""

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

from threadpoolctl import threadpool_limits

from resonator_daemon.acquisition.account import LinkAccount
from resonator_daemon.acquisition.frames import BoardRefused
from resonator_daemon.acquisition.host_time import HostTime
from resonator_daemon.acquisition.link_course import LinkCourse
from resonator_daemon.acquisition.recording_file import Mark, Recording
from resonator_daemon.acquisition.replay import Replay
from resonator_daemon.acquisition.ring import Ring
from resonator_daemon.acquisition.wire_events import WireEvent
from resonator_daemon.config import Config
from resonator_daemon.decoding.in_order import DecodingInOrder
from resonator_daemon.publishing.payloads import Message
from resonator_daemon.publishing.topics import Topic
from resonator_daemon.reporting.board_course import BoardCourse

_RING_BYTES: Final = 1 << 30  # what one event brings is taken at once


class Published(NamedTuple):
    """A message and its topic."""

    topic: Topic[Any]
    message: Message


class Moment(NamedTuple):
    """What followed from one event on the link, or a mark that somebody had made then."""

    now: HostTime
    messages: Sequence[Published] = ()
    mark: str | None = None


class Playback:
    """Plays one recording, once.

    Parameters
    ----------
    recording
        Open.
    config
        What to do with it.
    daemon_boot_id
        That messages are to bear.

    Attributes
    ----------
    config
        What is done with it.
    refused
        Why the board could not be measured, where it could not.
    """

    def __init__(self, recording: Recording, config: Config, daemon_boot_id: str) -> None:
        self._recording = recording
        self.config = config
        self._messages: list[Published] = []
        self._ring = Ring(_RING_BYTES, lambda: None, ())
        self._link = LinkCourse(config.plate, self._ring, lambda _: None)
        self._replay = Replay(recording, self._link)
        self._board = BoardCourse(config, daemon_boot_id, self._publish, make_stage=DecodingInOrder)
        self.refused: tuple[str, ...] = ()

    @property
    def differences(self) -> int:
        """How often what followed was not what is recorded."""
        return self._replay.differences

    @property
    def damage(self) -> str | None:
        """Why the recording ended before its end, once it has; None where the file is whole."""
        return self._recording.damage

    @property
    def read_bytes(self) -> int:
        """How much of the file was read."""
        return self._recording.read_bytes

    @property
    def account(self) -> LinkAccount:
        """Where the recorded bytes and frames went."""
        return self._link.account()

    def moments(self) -> Iterator[Moment]:
        """Give what follows from each event that anything follows from, and the marks, in order."""
        with threadpool_limits(1, user_api="blas"):  # so that sums are made in the same order everywhere
            for entry in self._recording.entries():
                if isinstance(entry, Mark):
                    yield Moment(entry.now, mark=entry.text)
                else:
                    self._replay.apply(entry)
                    if moment := self._after(entry):
                        yield moment
            if moment := self._after(self._replay.end()):
                yield moment

    def _after(self, event: WireEvent) -> Moment | None:
        for arrival in self._ring.take():
            if isinstance(arrival, BoardRefused):
                self.refused = arrival.problems
            self._board.take(arrival)
        self._board.pass_time(event.now.utc_ns)
        if not self._messages:
            return None
        messages, self._messages = self._messages, []
        return Moment(event.now, messages)

    def _publish(self, topic: Topic[Any], message: Any) -> None:
        self._messages.append(Published(topic, message))
