"""A recording from its bytes to its messages, one event after the other, without a clock or a second thread."""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from threadpoolctl import threadpool_limits

from resonator_daemon.board.config import Config
from resonator_daemon.board.recording.event_replay import Replay
from resonator_daemon.board.recording.reader import Mark, Recording, damage_in_words
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.counters import LinkCounters
from resonator_daemon.board.session.frame_queue import FrameQueue, group_adjacent
from resonator_daemon.board.session.frames import Arrival, BoardRefused, Frame
from resonator_daemon.board.session.link_events import WireEvent
from resonator_daemon.board.session.link_state_machine import LinkStateMachine
from resonator_daemon.measure.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import Topic

if TYPE_CHECKING:
    from resonator_daemon.measure.sensors.surface_decoding import MakeSurfaceDecoding

_FRAME_QUEUE_BYTES: Final = 1 << 30  # what one event brings is taken at once
_BLOCK_EVENTS: Final = 128  # whose frames are measured together
_BLOCK_FRAMES: Final = 1024


class Published(NamedTuple):
    """A message and its topic."""

    topic: Topic[Any]
    message: Message | Encoded


class Moment(NamedTuple):
    """What followed from one event on the link, or a mark that somebody had made then."""

    now: HostTime
    messages: Sequence[Published] = ()
    mark: str | None = None


class RecordingReplay:
    """Plays one recording, once.

    Parameters
    ----------
    recording
        Open.
    config
        What to do with it.
    daemon_boot_id
        That messages are to bear.
    make_decoding
        As of a `BoardPipeline`.

    Attributes
    ----------
    config
        What is done with it.
    refused
        Why the board could not be measured, where it could not.
    """

    def __init__(
        self,
        recording: Recording,
        config: Config,
        daemon_boot_id: str,
        make_decoding: "MakeSurfaceDecoding | None" = None,
    ) -> None:
        self._recording = recording
        self.config = config
        self._messages: list[Published] = []
        self._queue = FrameQueue(_FRAME_QUEUE_BYTES, lambda: None, ())
        self._link = LinkStateMachine(config.plate, self._queue, lambda _: None)
        self._replay = Replay(recording, self._link)
        self._board = BoardPipeline(config, daemon_boot_id, self._publish, make_decoding=make_decoding)
        self._waiting: list[tuple[HostTime, list[Arrival]]] = []  # events of which nothing but frames came
        self._waiting_frames: list[Frame] = []  # of all of these: they are adjacent
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
    def counters(self) -> LinkCounters:
        """Where the recorded bytes and frames went."""
        return self._link.counters()

    def moments(self) -> Iterator[Moment]:
        """Give what follows from each event that anything follows from, and the marks, in order."""
        with threadpool_limits(1, user_api="blas"):  # so that sums are made in the same order everywhere
            for entry in self._recording.entries():
                if isinstance(entry, Mark):
                    yield from self._measured()
                    yield Moment(entry.now, mark=entry.text)
                    continue
                self._replay.apply(entry)
                arrivals = self._queue.pop_all()
                if arrivals and not self._keep(arrivals):
                    yield from self._measured()
                    yield from self._apply_arrivals(entry, arrivals)
                    continue
                self._waiting.append((entry.now, arrivals))
                if len(self._waiting) >= _BLOCK_EVENTS:
                    yield from self._measured()
            yield from self._measured()
            yield from self._apply_arrivals(self._replay.end(), self._queue.pop_all())

    def _keep(self, arrivals: list[Arrival]) -> bool:
        """Keep frames to be measured with those of later events; return False where these do not merely adjoin."""
        frames = [arrival for arrival in arrivals if isinstance(arrival, Frame)]
        kept = self._waiting_frames
        if len(frames) < len(arrivals) or (kept and frames[0].index != kept[-1].index + 1):
            return False
        kept += frames
        return True

    def _apply_arrivals(self, event: WireEvent, arrivals: list[Arrival]) -> Iterator[Moment]:
        """Give what follows from an event and its arrivals, measured by themselves."""
        for arrival in group_adjacent(arrivals, _BLOCK_FRAMES):
            if isinstance(arrival, BoardRefused):
                self.refused = tuple(problem.text for problem in arrival.problems)
            self._board.handle(arrival)
        yield from self._at(event.now)

    def _measured(self) -> Iterator[Moment]:
        """Measure the frames that wait, together; give what follows from each of their events."""
        waiting, self._waiting = self._waiting, []
        frames, self._waiting_frames = self._waiting_frames, []
        readings = deque(self._board.sensor.measure(frames) if frames else ())
        start = 0
        for now, arrivals in waiting:
            if arrivals:
                arrived = frames[start : start + len(arrivals)]
                start += len(arrivals)
                of_event = []
                while readings and readings[0].sequence <= arrived[-1].index:
                    of_event.append(readings.popleft())
                self._board.publish(arrived, of_event)
            yield from self._at(now)

    def _at(self, now: HostTime) -> Sequence[Moment]:
        self._board.pass_time(now.utc_ns)
        if not self._messages:
            return ()
        messages, self._messages = self._messages, []
        return (Moment(now, messages),)

    def _publish(self, topic: Topic[Any], message: Any) -> None:
        self._messages.append(Published(topic, message))


def what_is_wrong(differences: int, damage: str | None, done: str = "replayed") -> list[str]:
    """Return a sentence for damage of the file, what came before which was `done`, and one for differences."""
    wrong = []
    if damage is not None:
        wrong.append(damage_in_words(damage, done))
    if differences:
        wrong.append(f"the replay differs from what is recorded in {differences} places")
    return wrong
