"""Replay of a recording to a broker or a file."""

import asyncio
import math
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.errors import ConfigurationError, InterruptedCommandError
from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.base.host.text import printable
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.payloads import Info
from resonator_daemon.mqtt.topics import Topic
from resonator_daemon.tools.command_line import broker_at, checked_name
from resonator_daemon.tools.replay.outputs import BrokerOutput, FileOutput
from resonator_daemon.tools.replay.recorded_pipeline import Moment, Published, RecordingReplay, open_replay
from resonator_daemon.tools.replay.span import Progress, Span, find_span

_AT_ONCE_S: Final = 1e-3  # a wait takes longer than this


@dataclass
class AtSpeed:
    """Recorded time passes this many times as fast as it did, from the first moment on.

    Parameters
    ----------
    speed
        Above 0; infinite: as fast as it goes.
    clock_ns, sleep
        Of the present.
    """

    speed: float
    clock_ns: Callable[[], int] = time.monotonic_ns
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep
    _begun: tuple[int, int] | None = None  # on the clock, and in recorded time

    async def wait_for(self, moment: Moment) -> None:
        if self._begun is None:
            self._begun = self.clock_ns(), moment.now.monotonic_ns
        clock_ns, recorded_ns = self._begun
        due_ns = clock_ns + (moment.now.monotonic_ns - recorded_ns) / self.speed
        left_s = (due_ns - self.clock_ns()) * 1e-9
        await self.sleep(left_s if left_s > _AT_ONCE_S else 0.0)


@dataclass
class Tally:
    """What a replay came to."""

    messages: Counter[str] = field(default_factory=Counter)
    first_ns: int | None = None  # of recorded time
    last_ns: int = 0
    found: bool = False  # whether anything is in the part that was asked for

    @property
    def recorded_s(self) -> float:
        return 0.0 if self.first_ns is None else (self.last_ns - self.first_ns) * 1e-9


@dataclass(frozen=True)
class ReplayOptions:
    """How to replay a recording.

    Parameters
    ----------
    config
        Instead of the plate and settings that the recording carries.
    output
        File for a line a message, `-` for stdout; None: a broker.
    url, name
        The broker, and the name to publish under; None: those of the configuration or the recording.
    speed
        Times real time; None: real time to a broker, as fast as possible to a file.
    start, end
        Mark or seconds; None: the recording's own.
    """

    config: Config | None = None
    output: Path | None = None
    url: str | None = None
    name: str | None = None
    speed: float | None = None
    start: str | None = None
    end: str | None = None
    show_progress: bool = False


def replay(path: Path, options: ReplayOptions) -> tuple[dict[str, Any], list[str]]:
    """Replay a recording; return what came of it by the keys of `--json`, and what is wrong with it.

    Raises
    ------
    UserError
        The options cannot be used, or the broker or the file takes nothing.
    InterruptedCommandError
        It was interrupted.
    LinkUnavailableError
        The file is no recording.
    """
    tally = Tally()
    try:
        return asyncio.run(_play_out(path, options, tally))
    except asyncio.CancelledError:
        words = f"{tally.messages.total()} messages were played out, {tally.recorded_s:.1f} s of the recording"
        partial_result = {"messages": dict(tally.messages), "seconds": round(tally.recorded_s, 3)}
        raise InterruptedCommandError(f"interrupted: {words}", partial_result=partial_result) from None


async def _play_out(path: Path, options: ReplayOptions, tally: Tally) -> tuple[dict[str, Any], list[str]]:
    config = options.config
    span = find_span(path, options.start, options.end)
    summary: dict[str, Any] = {}
    output: FileOutput | BrokerOutput
    if options.output is not None:
        output, boot_id, speed = FileOutput(options.output), None, options.speed or math.inf
    else:
        by = "--name" if options.name else f"the name in {path}, which --name replaces"
        name = checked_name(options.name or _recorded_name(path, config), by)
        output = BrokerOutput(_broker(options.url, config), name, path.name)
        boot_id, speed = output.daemon_boot_id, options.speed or 1.0
        summary["name"] = name
    with open_replay(path, config, boot_id) as replaying:
        with Progress(path, shown=options.show_progress) as progress:
            async with output:
                playing = asyncio.create_task(play(replaying, span, AtSpeed(speed), output, progress, tally))
                with on_signals(playing.cancel):  # after which the end is published
                    await playing
        if isinstance(output, BrokerOutput):
            summary["dropped"] = output.dropped
        counters = replaying.counters
        summary |= {
            "frames": counters.frames,
            "frames_lost": asdict(counters.lost),
            "messages": dict(tally.messages),
            "seconds": round(tally.recorded_s, 3),
            "differences": replaying.differences,
            "damage": replaying.damage,
            "refused": list(replaying.refused),
        }
        wrong = replaying.problems()
        return summary, wrong if tally.found else [*wrong, f"it gives no messages{span.words}"]


async def play(
    replaying: RecordingReplay,
    span: Span,
    pacing: AtSpeed,
    output: FileOutput | BrokerOutput,
    progress: Progress,
    tally: Tally,
) -> None:
    """Play a part of a recording out; what is before it is played, too, but its retained messages alone are kept."""
    retained: dict[Topic[Any], Published] = {}
    for moment in replaying.moments():
        progress.at(replaying.read_bytes)
        if span.is_over(moment.now):
            break
        if span.is_before(moment.now):
            retained |= {published.topic: published for published in moment.messages if published.topic.retained}
            continue
        if moment.mark is not None:
            progress.print(f"mark: {printable(moment.mark)}")
            continue
        if retained:
            moment = Moment(moment.now, (*retained.values(), *moment.messages))
            retained = {}
        tally.found = True
        await pacing.wait_for(moment)
        for published in moment.messages:
            await output.put(published)
            tally.messages[published.topic.path] += 1
        if tally.first_ns is None:
            tally.first_ns = moment.now.monotonic_ns
        tally.last_ns = moment.now.monotonic_ns


def _broker(url: str | None, config: Config | None) -> Mqtt:
    if url is not None:
        return broker_at(url, config.mqtt.prefix if config is not None else Mqtt().prefix)
    default = Mqtt().with_name("--url; without a broker, use --to - or resonatord view FILE")
    return default if config is None else config.mqtt


def _recorded_name(path: Path, config: Config | None) -> str:
    """Return the name that a daemon had published under, or would have: the board's serial number."""
    with open_replay(path, config) as replaying:
        if replaying.config.name is not None:
            return replaying.config.name
        for moment in replaying.moments():
            for published in moment.messages:
                if isinstance(published.message, Info) and published.message.serial_number:
                    return published.message.serial_number
    raise ConfigurationError(f"{path} has neither the name of a daemon nor the serial number of a board; give --name")
