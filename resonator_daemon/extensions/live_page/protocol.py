"""The page's protocol: messages to a browser, which wait in its queue, and requests of it, which are checked."""

import asyncio
import json
from collections import deque
from typing import Annotated, Any, Final, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from resonator_daemon.base.toml import shown
from resonator_daemon.mqtt.topics import TOPICS

STREAMS: Final = frozenset(path for path, topic in TOPICS.items() if topic.qos == 0)
LIVE: Final = "live"  # the source that is a broker; recordings are `a` and `b`
ADDRESS_MAX: Final = 255  # bytes, which one byte counts
WAITING_MAX: Final = 2000  # messages other than streams
WAITING_BYTES_MAX: Final = 64 << 20


def payload_frame(source: str, plate: str, path: str, payload: bytes) -> bytes | None:
    """Return a binary message: one byte n, n bytes `source/plate/path`, the payload.

    None: the address is too long.
    """
    address = f"{source}/{plate}/{path}".encode()
    if len(address) > ADDRESS_MAX:
        return None
    return b"".join((bytes((len(address),)), address, payload))


def payload_of(frame: bytes) -> bytes:
    """Return the payload of a binary message."""
    return frame[1 + frame[0] :]


def text_frame(key: str, content: Any) -> str:
    """Return a text message: a JSON object with one key."""
    return json.dumps({key: content}, separators=(",", ":"))


class Outgoing:
    """Messages for one browser, which its sender takes one after the other; nothing here waits.

    Attributes
    ----------
    skipped
        Messages of streams that were replaced by newer ones before they were sent.
    overflowed
        Whether a message other than those of streams was dropped, because too many waited: the browser has to begin
        again.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self.overflowed = False
        self._others: deque[bytes | str] = deque()
        self._bytes = 0
        self._streams: dict[str, bytes | str] = {}
        self._some = asyncio.Event()

    def put(self, message: bytes | str) -> None:
        """Append a message that must arrive."""
        if len(self._others) >= WAITING_MAX or self._bytes + len(message) > WAITING_BYTES_MAX:
            self.overflowed = True
        else:
            self._others.append(message)
            self._bytes += len(message)
        self._some.set()

    def put_newest(self, stream: str, message: bytes | str) -> None:
        """Put a message of a stream in the place of the one that waits."""
        self.skipped += stream in self._streams
        self._streams[stream] = message
        self._some.set()

    def clear_streams(self, prefix: str) -> None:
        """Discard what waits of the streams whose names begin with `prefix`."""
        self._streams = {name: message for name, message in self._streams.items() if not name.startswith(prefix)}

    async def get(self) -> bytes | str | None:
        """Remove and return the next message, once there is one; None if one was dropped.

        Streams come last, the one that has waited longest first.
        """
        while not self.overflowed:
            if self._others:
                message = self._others.popleft()
                self._bytes -= len(message)
                return message
            if self._streams:
                return self._streams.pop(next(iter(self._streams)))
            self._some.clear()
            await self._some.wait()
        return None


Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Source = Literal["live", "a", "b"]


def _stream(path: str) -> str:
    if path not in STREAMS:
        raise ValueError(f"must be of {', '.join(sorted(STREAMS))}")
    return path


PlateName = Annotated[str, Field(min_length=1, max_length=200, strict=True)]


class RefusedRequest(Exception):  # noqa: N818  # an answer to the page, no error of the server
    """A request that changes nothing: `code` for programs, the message for people."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class Content(BaseModel):
    """The value of a request's key."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Watch(Content):
    """Send streams of this plate, instead of those of the one before."""

    source: Source = "live"
    plate: PlateName
    topics: frozenset[Annotated[str, AfterValidator(_stream)]] = STREAMS


class Command(Content):
    """Send a command to the daemon of a plate."""

    plate: PlateName
    verb: str
    arguments: dict[str, Any] = {}


class Press(Content):
    """Press an emulated plate; keys but these are the control socket's."""

    model_config = ConfigDict(extra="allow", frozen=True)

    plate: PlateName
    name: str


class Release(Content):
    """End a touch of an emulated plate."""

    plate: PlateName
    name: str


class Play(Content):
    """Play a recording, or pause it."""

    source: Source
    playing: bool
    speed: Annotated[Finite, Field(ge=0.05, le=20.0)] | None = None


class Seek(Content):
    """Go on at another time of a recording, in seconds from its beginning."""

    source: Source
    t_s: Annotated[Finite, Field(ge=-1e9, le=1e9)]


class Recordings(Content):
    """List the recordings of the page's directory."""


class Open(Content):
    """Show these recordings of the directory, from their beginnings, instead of those before; none: close them."""

    names: Annotated[list[str], Field(max_length=2)]


KINDS: Final[dict[str, type[Content]]] = {
    "watch": Watch,
    "command": Command,
    "press": Press,
    "release": Release,
    "play": Play,
    "seek": Seek,
    "recordings": Recordings,
    "open": Open,
}


class Request(NamedTuple):
    """A request, and the number that its answer carries; None: it is answered only if it is refused."""

    number: int | str | None
    content: Content


def read_number(text: str) -> int | str | None:
    """Return the `id` of a request that may be malformed."""
    try:
        number = json.loads(text).get("id")
    except (ValueError, RecursionError, AttributeError):
        return None
    return number if isinstance(number, int | str) else None


def read_request(text: str) -> Request:
    """Read a request.

    Raises
    ------
    RefusedRequest
        It is malformed.
    """
    try:
        whole = json.loads(text)
    except (ValueError, RecursionError):
        raise RefusedRequest("not_json", "a request is a text message with a JSON object") from None
    found = [key for key in whole if key != "id"] if isinstance(whole, dict) else []
    if len(found) != 1 or found[0] not in KINDS:
        raise RefusedRequest("no_verb", f"a request has `id` and one of {', '.join(KINDS)}")
    try:
        content = KINDS[found[0]].model_validate(whole[found[0]])
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, (found[0], *first["loc"])))
        raise RefusedRequest("bad_value", f"{where}: got {shown(first['input'])}; {first['msg']}") from None
    return Request(read_number(text), content)
