"""State of a daemon as a block of text: conditions, rates and ages."""

import json
import math
from collections.abc import Iterable, Iterator
from typing import Final

from pydantic import ValidationError
from rich.text import Text

from resonator_daemon.base.host.text import printable
from resonator_daemon.daemon.monitoring.status import Status
from resonator_daemon.daemon.monitoring.status_client import Answer
from resonator_daemon.mqtt.payloads import Condition, Health, State
from resonator_daemon.tools.view.words import UNKNOWN, duration, losses_in_words, quantity

_LABEL_WIDTH: Final = 11
_STYLES: Final = {
    Condition.ONLINE: "green",
    Condition.STARTING: "yellow",
    Condition.WAITING: "yellow",
    Condition.DRIFTING: "yellow",
    Condition.UNCALIBRATED: "yellow",
    Condition.PRESSED_AT_START: "yellow",
}


def status_page(answers: Iterable[Answer]) -> Text:
    """Return the blocks of several daemons; of one that gave no answer that can be read, why."""
    return Text("\n\n").join(map(_block_or_problem, answers))


def _block_or_problem(answer: Answer) -> Text:
    problem = answer.problem
    if problem is None:
        try:
            return _block(Status.model_validate_json(json.dumps(answer.status)))
        except ValidationError as error:
            version = (answer.status or {}).get("version", "unknown")
            keys = ", ".join(sorted({".".join(map(str, found["loc"])) for found in error.errors()}))
            problem = f"its version {version} sends a status that this version cannot read ({keys}); --json shows it"
    return Text.assemble((answer.socket.parent.name, "bold"), "   ", (printable(problem), "yellow"))


def _block(status: Status) -> Text:
    title = printable(status.name or "(its name comes from the board)")
    about = f"process {status.pid}, resonatord {printable(status.version)}, up {_age(status, 'started')}"
    lines = [Text.assemble((title, "bold"), f"   {about}")]
    lines += [Text(f"  {label:<{_LABEL_WIDTH}}").append_text(text) for label, text in _lines(status)]
    return Text("\n").join(lines)


def _lines(status: Status) -> Iterator[tuple[str, Text]]:
    for part, state in (("daemon", status.daemon), ("link", status.link), ("sensor", status.sensor)):
        yield part, _state(status, part, state) if state else Text(UNKNOWN)
    if status.health is not None:
        yield (
            "frames",
            Text(f"{quantity(status.health.frame_rate_hz, '.0f', '/s')}, {_count(status.health.frames)} in all"),
        )
        yield "lost", _lost(status.health)
        yield "clock", Text(_clock(status.health))
    yield "broker", _broker(status)
    if status.health is not None:
        yield "messages", _messages(status.health)
    yield "recording", _recording(status)
    for text in _config(status):
        yield "config", text
    if status.health is not None:
        health = status.health
        load = quantity(health.cpu_percent, ".1f", " % of a core")
        memory = quantity(health.rss_mb, ".0f", " MB")
        yield "process", Text(f"{load}, {memory}, {health.file_descriptors} file descriptors, {health.threads} threads")


def _state(status: Status, part: str, state: State) -> Text:
    text = Text.assemble((str(state.state), _STYLES.get(state.state, "red")))
    if state.reason:
        text.append(f": {printable(state.reason)}")
    if state.since_t_ns is not None:
        text.append(f" (for {_age(status, part)})")
    if state.boot_count is not None and state.boot_count > 1:
        text.append(f"; {state.boot_count} boots of the board")
    if (outage := state.last_outage) is not None:
        length_s = (outage.end_t_ns - outage.start_t_ns) * 1e-9
        text.append(
            f"; {_age(status, 'outage')} ago {duration(length_s)} without frames, "
            f"{_count(outage.frames_lost)} lost: {printable(outage.reason)}"
        )
    return text


def _lost(health: Health) -> Text:
    counts = health.lost.model_dump() | {"parts": health.parts_lost, "not_decoded": health.frames_not_decoded}
    unusable = ", ".join(f"{_count(count)} {_in_words(cause)}" for cause, count in health.records_unusable.items())
    text = losses_in_words(counts) + (f"; readings unusable: {unusable}" if unusable else "")
    return Text(text, "yellow" if any(counts.values()) else "")


def _clock(health: Health) -> str:
    known = math.isfinite(health.clock_drift_ppm)
    drift = f"board {health.clock_drift_ppm:+.1f} ppm" if known else "rate of the board unknown"
    return f"{drift}, {_count(health.clock_outliers)} outliers, {_count(health.clock_restarts)} restarts"


def _broker(status: Status) -> Text:
    url = printable(status.broker.url)
    if not status.broker.connected:
        return Text.assemble(url, ", ", ("not connected", "red"))
    known = "connected" in status.ages_s
    return Text(f"{url}, connected" + (f" for {_age(status, 'connected')}" if known else ""))


def _messages(health: Health) -> Text:
    account = health.messages
    sent = account.acknowledged + account.written
    text = Text(f"{_count(sent)} sent, {_count(account.waiting)} waiting")
    if account.spooled:
        text.append(f" ({_count(account.spooled)} of them on disk)")
    dropped = ", ".join(f"{_count(count)} {_in_words(cause)}" for cause, count in account.dropped.items() if count)
    return text.append("; dropped: ").append(dropped or "none", "yellow" if dropped else "")


def _recording(status: Status) -> Text:
    recording = status.recording
    text = Text("off")
    if recording.file is not None and recording.since_t_ns is not None:
        size = f"{recording.file_bytes / 1e6:.1f} MB"
        text = Text(f"{printable(recording.file)}, {size} (for {_age(status, 'recording')})")
    if recording.files > (recording.file is not None):
        text.append(f"; {_count(recording.files)} files since the start")
    if recording.files_removed:
        text.append(f", {_count(recording.files_removed)} old ones removed for the budget")
    if missing := recording.events_missing + recording.messages_missing:
        text.append(f"; {_count(missing)} pieces missing", "yellow")
    if recording.failure is not None:
        text.append(f"; stopped: {printable(recording.failure)}", "red")
    return text


def _config(status: Status) -> Iterator[Text]:
    config = status.config
    if config.in_use == "file":
        text = Text(f"{printable(config.file)}, read {_age(status, 'config')} ago")
        if config.problems:
            text.append("; as it is now it ").append("cannot be used", "red").append(":")
        yield text
    else:
        read = f", read {_age(status, 'config')} ago"
        yield Text.assemble(("the last good one", "red"), f"{read}; {printable(config.file)} has problems:")
    for problem in config.problems:
        yield Text(printable(problem))
    if config.needs_restart:
        yield Text.assemble(
            ("restart", "yellow"), f" for what has changed: {', '.join(map(printable, config.needs_restart))}"
        )


def _in_words(cause: str) -> str:
    return printable(cause).replace("_", " ")


def _count(count: int) -> str:
    return f"{count:,}".replace(",", " ")


def _age(status: Status, moment: str) -> str:
    return duration(status.ages_s.get(moment, math.nan))
