"""The commands on `cmd/<verb>`: what each takes and what it answers. A request with a key too many is refused."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Annotated, Final, Literal, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from resonator_daemon.base.reasons import ReasonCode, Word
from resonator_daemon.board.config.tables import ChangingVerb
from resonator_daemon.mqtt.payload_types import optional
from resonator_daemon.mqtt.payloads import ContactEvent, Int64, Message, PerChannel

LABEL_PATTERN: Final = "^[A-Za-z0-9_-]{1,64}$"
ID_LENGTH_MAX: Final = 64
UNKNOWN: Final = "unknown"  # `verb` of the refusal of any other command, and the last level of its topic


class ErrorCode(Word):
    """Why a command was refused."""

    UNKNOWN_VERB = "unknown_verb", "there is no such command"
    NOT_PERMITTED = "not_permitted", "it changes something, and the configuration does not allow it"
    PAYLOAD = "payload", "not a JSON object of this command, an empty payload, or more than 16 KiB"
    RESPONSE_TOPIC = "response_topic", "a topic with wildcards, or a daemon's own outside `rsp/`"
    CORRELATION = "correlation", "correlation data of more than 1024 bytes"
    TOO_MANY = "too_many", "more than 20 at once, or 10 a second; most of those get no answer at all"
    BUSY = "busy", "32 commands wait already"
    TIMEOUT = "timeout", "not done within 8 s; it may still be done"
    FAILED = "failed", "an error of the daemon; its log has more"
    NOT_READY = (
        "not_ready",
        "no force sites are being measured: no board, or a plate with a skin; or the link is a recording",
    )
    NOT_UNTOUCHED = "not_untouched", "the plate is touched, or not all of it is detected"
    RECORDING = "recording", "another recording runs"
    NOT_RECORDING = "not_recording", "nothing is being recorded"
    RECORDING_FAILED = "recording_failed", "the file cannot be made, or takes nothing more"
    WINDOW = "window", "window and step do not fit each other, or the frames"
    NOT_PUBLISHED = "not_published", "the daemon does not publish this stream"
    UNKNOWN_BOOT = "unknown_boot", "no run with this `daemon_boot_id` is on record"
    STORAGE_FAILED = "storage_failed", "stored events of an earlier run cannot be read"
    NOT_LOCATED = "not_located", "the board did not answer, or cannot blink"


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("must be printable characters, without line breaks and control characters")
    return text


RequestId = Annotated[str, Field(min_length=1, max_length=ID_LENGTH_MAX), AfterValidator(_printable)]


def _whole(value: object) -> object:
    return int(value) if isinstance(value, float) and value.is_integer() else value


WholeNumber = Annotated[int, BeforeValidator(_whole)]
"""An integer as JSON Schema has it: 8.0 is one."""


class Request(BaseModel):
    """Base of the commands; `{}` for one without fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    id: RequestId | None = Field(None, description="1 to 64 printable characters, repeated in the answer")


class Answer(Message):
    """Base of the answers to what was done."""

    verb: str
    ok: Literal[True] = True
    id: RequestId | None = Field(None, description="that of the request; null where it had none")


class Problem(Message):
    """Why a command was refused."""

    code: ErrorCode
    message: str = Field(description="sentence for display: what is wrong")
    hint: str = Field(description="what to do about it; may be empty")


class Refusal(Message):
    """The answer to what was not done."""

    verb: str
    ok: Literal[False] = False
    id: RequestId | None = Field(None, description="that of the request; null where it had none that could be read")
    error: Problem


class Ping(Request):
    """Request to confirm that the daemon runs."""


class Pong(Answer):
    """Confirmation that the daemon runs."""

    verb: Literal["ping"] = "ping"
    t_ns: Int64 = Field(description="UTC, when the answer was made")
    daemon_boot_id: str
    uptime_s: float


class Events(Request):
    """Ask for the stored events of a run of the daemon; the next page is asked for with the last `seq` of this one."""

    after_seq: WholeNumber = Field(-1, ge=-1, le=2**53 - 1, description="`seq` of the last event that the client has")
    daemon_boot_id: Annotated[str, Field(min_length=1, max_length=64)] | None = Field(
        None, description="of an earlier run; the present one where not given"
    )


class EventsAnswer(Answer):
    """Stored events, in order; there are more where the last one is older than `newest_seq`."""

    verb: Literal["events"] = "events"
    daemon_boot_id: str = Field(description="of the run that the events are of")
    events: tuple[ContactEvent, ...] = Field(description="those after `after_seq`, with `replayed` true")
    complete: bool = Field(description="false: some of those after `after_seq` are no longer stored")
    oldest_seq: int | None = Field(description="of the oldest that is stored of this run; null where none is")
    newest_seq: int | None = Field(description="of the newest that happened in this run; null where none did")
    next_daemon_boot_id: str | None = Field(description="of the next run that is stored; null for the present run")


class Tare(Request):
    """Request to take the present readings as those of the untouched plate."""


class TareAnswer(Answer):
    """The new zero."""

    verb: Literal["tare"] = "tare"
    message: str = Field(description="sentence for display, always the same: programs read `ok`")
    common_mode: PerChannel = Field(description="relative frequency error by channel")


class StartRecording(Request):
    """Record the link to a file; the daemon chooses its name, and where."""

    label: Annotated[str, Field(pattern=LABEL_PATTERN)] | None = Field(None, description="becomes part of the name")


class StartRecordingAnswer(Answer):
    """The recording that runs."""

    verb: Literal["start_recording"] = "start_recording"
    file: str = Field(description="on the daemon's machine")
    since_t_ns: Int64 = Field(description="UTC")
    was_active: bool = Field(description="it ran before this command came")


class StopRecording(Request):
    """End the recording."""


class RecordingSummaryInfo(Message):
    """What a recording that has ended holds."""

    file: str = Field(description="the last of its files, on the daemon's machine")
    files: int
    all_bytes: int = Field(description="of all its files")
    events: int = Field(description="pieces of the link's traffic that are in its files")
    events_missing: int = Field(description="those that are in none: the disk was too slow or failed")
    duration_s: float
    failure_code: ReasonCode | None = optional(
        "why nothing more was written, for programs; left out where all was well"
    )
    failure: str | None = Field(description="the same as a sentence; null where all was well")


class StopRecordingAnswer(Answer):
    """No recording runs any more."""

    verb: Literal["stop_recording"] = "stop_recording"
    recording: RecordingSummaryInfo | None = Field(description="the last one; null where none ran yet")
    was_active: bool = Field(description="a recording ran when this command came")


class Mark(Request):
    """Write a remark into the recording."""

    text: Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)] = Field(
        description="printable characters"
    )


class MarkAnswer(Answer):
    """Position of the mark in the recording."""

    verb: Literal["mark"] = "mark"
    t_ns: Int64 = Field(description="UTC")


_Span = Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]


class SetWindow(Request):
    """Set how long is counted for one force and how often one is published; until the daemon ends."""

    window_ms: _Span | None = Field(None, description="as it was where not given")
    step_ms: _Span | None = Field(None, description="as it was where not given")


class SetWindowAnswer(Answer):
    """Window and step from the next message on."""

    verb: Literal["set_window"] = "set_window"
    window_s: float
    step_s: float


class Identify(Request):
    """Request to make the board blink."""


class IdentifyAnswer(Answer):
    """The board has answered that it blinks."""

    verb: Literal["identify"] = "identify"


@dataclass(frozen=True)
class Verb:
    """One command."""

    request: type[Request]
    answer: type[Answer]
    summary: str

    @property
    def name(self) -> str:
        name: str = self.answer.model_fields["verb"].default
        return name

    @property
    def changes(self) -> bool:
        """Whether it changes anything, and therefore has to be permitted by the configuration."""
        return self.name in get_args(ChangingVerb)


VERBS: Final[dict[str, Verb]] = {
    verb.name: verb
    for verb in (
        Verb(Ping, Pong, "confirms that the daemon runs"),
        Verb(Events, EventsAnswer, "answers with stored events"),
        Verb(Tare, TareAnswer, "takes the present readings as those of the untouched plate"),
        Verb(StartRecording, StartRecordingAnswer, "records the link to a file"),
        Verb(StopRecording, StopRecordingAnswer, "ends the recording"),
        Verb(Mark, MarkAnswer, "writes a remark into the recording"),
        Verb(SetWindow, SetWindowAnswer, "sets window and step of the forces"),
        Verb(Identify, IdentifyAnswer, "makes the board blink"),
    )
}


def permitted(allowed: Collection[str]) -> tuple[str, ...]:
    """Return the verbs that a daemon executes: those that change nothing, and those that its configuration allows."""
    return tuple(verb.name for verb in VERBS.values() if not verb.changes or verb.name in allowed)
