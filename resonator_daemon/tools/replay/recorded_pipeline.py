"""A recording from its bytes to its messages, with the plate and settings that it carries or others; reads no clock."""

import tomllib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from threadpoolctl import threadpool_limits

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.host.text import printable
from resonator_daemon.base.plate import Plate
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.values import Settings, config_of, load_plate_text, load_settings_text
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.recording.event_replay import Replay
from resonator_daemon.board.recording.reader import (
    PLATE_FILE,
    SETTINGS_FILE,
    FilePath,
    Mark,
    Recording,
    damage_in_words,
    open_recording,
)
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.frame_queue import FrameQueue, group_adjacent
from resonator_daemon.board.session.frames import Arrival, BoardRefused, Frame, LinkCounters
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

    def problems(self, done: str = "replayed") -> list[str]:
        """Return a sentence for damage of the file, what came before which was `done`, and one for differences."""
        found = [] if self.damage is None else [damage_in_words(self.damage, done)]
        if self.differences:
            found.append(f"the replay differs from what is recorded in {self.differences} places")
        return found

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


_Loaded = TypeVar("_Loaded")

UNKNOWN_BOOT_ID: Final = "0" * 8  # of a recording that no daemon made


@contextmanager
def open_replay(
    path: FilePath, config: Config | None = None, daemon_boot_id: str | None = None
) -> Iterator[RecordingReplay]:
    """Open a recording to be played with what it carries, or with another configuration of the same plate.

    Messages bear the given boot id of a daemon, or else the recorded one.

    Raises
    ------
    LinkUnavailableError
        No such file, no recording, of another format, or of a plate whose frames are others.
    ConfigurationError
        What it carries is damaged or does not suit this version, or a configuration is missing and it carries none.
    """
    with open_recording(path, config.plate if config else None) as recording:
        boot_id = daemon_boot_id or recording.header.get("daemon_boot_id", UNKNOWN_BOOT_ID)
        yield RecordingReplay(recording, config or recorded_config(recording), boot_id)


def recorded_config(recording: Recording, plate: Plate | None = None, settings: Settings | None = None) -> Config:
    """Return the configuration that a recording carries, as far as it matters to its messages.

    A plate and settings that are given replace those of the recording.
    """
    path = recording.path
    plate_text, settings_text = recording.plate_text, recording.settings_text
    if (plate is None and plate_text is None) or (settings is None and settings_text is None):
        if recording.damaged_attachments:
            raise _damaged(path, recording.damaged_attachments[0])
        raise ConfigurationError(f"{path} does not carry its plate file and settings; give --config FILE")
    try:
        link = parse_link(recording.header.get("link"))
    except ValueError as error:
        raise ConfigurationError(f"{path}: link: {error}") from error
    plate = plate or _loaded(load_plate_text, plate_text or "", path, PLATE_FILE)
    settings = settings or _loaded(load_settings_text, settings_text or "", path, SETTINGS_FILE)
    return config_of(plate, settings, link, name=recording.header.get("name"))


def _loaded(load: Callable[[str, str], _Loaded], text: str, path: str, name: str) -> _Loaded:
    """Load a text of the recording; errors add that the file itself cannot be edited."""
    try:
        return load(text, f"{path}/{name}")
    except ConfigurationError as error:
        try:
            tomllib.loads(text)
        except (ValueError, RecursionError):
            raise _damaged(path, name) from error
        raise ConfigurationError(*error.messages, f"{path}: its {name} cannot be used; give --config FILE") from error


def _damaged(path: str, name: str) -> ConfigurationError:
    return ConfigurationError(
        f"{path}: its attachment {printable(name)} is damaged; give plate and settings with --config FILE"
    )
