"""`resonatord replay`: a recording played out, to a broker or a file, or cases compared with what they expect."""

import argparse
import asyncio
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from resonator_daemon.config import Config, Mqtt, load_config, plate_name
from resonator_daemon.errors import ConfigurationError, ExitCode, InterruptedCommandError, UserError, failure_told
from resonator_daemon.host.new_file import interruptible
from resonator_daemon.host.printable import printable
from resonator_daemon.links.link import LinkUnavailableError
from resonator_daemon.publishing.payloads import Info
from resonator_daemon.publishing.topics import Topic
from resonator_daemon.replay.broker import AtBroker
from resonator_daemon.replay.case import save_case
from resonator_daemon.replay.checking import check_cases
from resonator_daemon.replay.options import DEFAULT_URL, check_options
from resonator_daemon.replay.outputs import Lines, Output
from resonator_daemon.replay.pacing import AtOnce, AtSpeed, Pacing, StepByStep
from resonator_daemon.replay.progress import Progress
from resonator_daemon.replay.recorded_pipeline import Moment, Playback, Published
from resonator_daemon.replay.source import open_playback
from resonator_daemon.replay.span import Span, find_span
from resonator_daemon.view.watch import broker_at


class NotReplayableError(UserError):
    """The file is no recording that can be replayed."""

    exit_code = ExitCode.UNAVAILABLE
    code = "no_recording"


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


def replay_as_asked(options: argparse.Namespace) -> ExitCode:
    """Replay, and say what came of it.

    Raises
    ------
    UserError
        The file, the configuration or the options cannot be used; the broker or the file takes nothing.
    """
    check_options(options)
    with failure_told("replay", as_json=options.json):
        if options.check is not None:
            return check_cases(options.check, as_json=options.json)
        try:
            return _replay(options)
        except LinkUnavailableError as error:
            raise NotReplayableError(printable(str(error))) from error


def _replay(options: argparse.Namespace) -> ExitCode:
    path: Path = options.file
    if options.step and not sys.stdin.isatty():
        options.refuse("--step waits for Enter, and there is no terminal to hear it from; try --speed")
    config = load_config(options.config) if options.config is not None else None
    begun_s = time.monotonic()
    if options.save_case is not None:
        with interruptible("no case is made"):
            case = save_case(path, options.save_case)
        told = {"case": str(options.save_case), **case.summary}
        wrong = _what_is_wrong(case.differences, case.damage)
    else:
        tally = Tally()
        with interruptible("what was written stays") if options.to is not None else _interruptible_at_broker(tally):
            told, wrong = asyncio.run(_play_out(options, path, config, tally))
    took_s = time.monotonic() - begun_s
    if "seconds" in told:
        told |= {"took_seconds": round(took_s, 3), "speed": round(told["seconds"] / took_s, 2)}
    if options.json:
        sys.stdout.write(json.dumps({"verb": "replay", "ok": not wrong, "file": str(path), **told}) + "\n")
    else:
        messages = sum(told["messages"].values())
        sys.stderr.write(f"{printable(str(path))}: {told['frames']} frames, {messages} messages in {took_s:.1f} s\n")
    for sentence in wrong:
        sys.stderr.write(f"resonatord: {printable(f'{path}: {sentence}')}\n")
    return ExitCode.FAILED if wrong else ExitCode.DONE


def _what_is_wrong(differences: int, damage: str | None) -> list[str]:
    wrong = []
    if damage is not None:
        wrong.append(f"the file is {damage}; all before that was replayed")
    if differences:
        wrong.append(f"the replay differs from what is recorded in {differences} places")
    return wrong


@contextmanager
def _interruptible_at_broker(tally: Tally) -> Iterator[None]:
    """Say what was played until Ctrl-C, which asyncio hears itself, so that the broker is told of the end."""
    try:
        yield
    except KeyboardInterrupt:
        words = f"{tally.messages.total()} messages were played out, {tally.recorded_s:.1f} s of the recording"
        so_far = {"messages": dict(tally.messages), "seconds": round(tally.recorded_s, 3)}
        raise InterruptedCommandError(f"interrupted: {words}", so_far) from None


async def _play_out(
    options: argparse.Namespace, path: Path, config: Config | None, tally: Tally
) -> tuple[dict[str, Any], list[str]]:
    span = find_span(path, options.start, options.end)
    told: dict[str, Any] = {}
    output: Output
    if options.to is not None:
        output, boot_id, speed = Lines(options.to), None, options.speed or math.inf
    else:
        name = options.name or _recorded_name(path, config)
        named_by = "--url" if config is None or options.url is not None else "mqtt.url"
        output = AtBroker(_broker(options.url, config), _sound(name), path.name, named_by=named_by)
        boot_id, speed = output.daemon_boot_id, options.speed or 1.0
        told["name"] = name
    with open_playback(path, config, boot_id) as playback:
        pacing: Pacing = AtOnce() if speed == math.inf else AtSpeed(speed)
        if options.step:
            pacing = StepByStep(span.begun)
        with Progress(path, shown=not options.step and not options.json) as progress:
            async with output:
                await play(playback, span, pacing, output, progress, tally)
        if isinstance(output, AtBroker):
            told["dropped"] = output.dropped
        account = playback.counters
        told |= {
            "frames": account.frames,
            "frames_lost": asdict(account.lost),
            "messages": dict(tally.messages),
            "seconds": round(tally.recorded_s, 3),
            "differences": playback.differences,
            "damage": playback.damage,
            "refused": list(playback.refused),
        }
        wrong = _what_is_wrong(playback.differences, playback.damage)
        return told, wrong if tally.found else [*wrong, f"it gives no messages{span.words}"]


async def play(
    playback: Playback, span: Span, pacing: Pacing, output: Output, progress: Progress, tally: Tally
) -> None:
    """Play a part of a recording out; what is before it is played, too, but its retained messages alone are kept."""
    retained: dict[Topic[Any], Published] = {}
    for moment in playback.moments():
        progress.at(playback.read_bytes)
        if span.is_over(moment.now):
            break
        if span.is_before(moment.now):
            retained |= {published.topic: published for published in moment.messages if published.topic.retained}
            continue
        if moment.mark is not None:
            progress.say(f"mark: {printable(moment.mark)}")
            continue
        if retained:
            moment = Moment(moment.now, (*retained.values(), *moment.messages))
            retained = {}
        tally.found = True
        try:
            await pacing.wait_for(moment)
        except EOFError:  # nobody is left to press Enter
            break
        for published in moment.messages:
            await output.put(published)
            tally.messages[published.topic.path] += 1
        if tally.first_ns is None:
            tally.first_ns = moment.now.monotonic_ns
        tally.last_ns = moment.now.monotonic_ns


def _broker(url: str | None, config: Config | None) -> Mqtt:
    if config is not None and url is None:
        return config.mqtt
    return broker_at(url or DEFAULT_URL, config.mqtt.prefix if config is not None else Mqtt().prefix)


def _recorded_name(path: Path, config: Config | None) -> str:
    """Return the name that a daemon had published under, or would have: the board's serial number."""
    with open_playback(path, config) as playback:
        if playback.config.name is not None:
            return playback.config.name
        for moment in playback.moments():
            for published in moment.messages:
                if isinstance(published.message, Info) and published.message.serial_number:
                    return published.message.serial_number
    raise ConfigurationError(f"{path} tells neither the name of a daemon nor the serial number of a board; give --name")


def _sound(name: str) -> str:
    try:
        return plate_name(name)
    except ValueError as error:
        raise ConfigurationError(f"name {name!r} {error}; give another by --name") from error
