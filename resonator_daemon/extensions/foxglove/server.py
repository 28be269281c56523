"""`resonatord bridge foxglove`: serves what plates publish over Foxglove's WebSocket protocol.

Encodes only what a viewer has subscribed to. A viewer that subscribes receives the last message of channels that change
seldom. Of a viewer that does not keep up, the oldest messages are dropped.
"""

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import aclosing, suppress
from typing import Any, Final

from resonator_daemon.base.errors import ListenError, MissingLibraryError
from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.config.tables import Listen
from resonator_daemon.extensions.foxglove.messages import ChannelMessage, FoxgloveMessages
from resonator_daemon.extensions.viewer_support import Geometry
from resonator_daemon.mqtt.payloads import Condition, Info, Message, State
from resonator_daemon.mqtt.subscriber import EVERY_PLATE, subscribe
from resonator_daemon.mqtt.topics import TOPICS

try:
    import foxglove
    from foxglove.websocket import ServerListener
except ImportError as error:
    raise MissingLibraryError(f"the bridge to Foxglove needs foxglove-sdk: {how_to_install('foxglove-sdk')}") from error

BACKLOG_MAX: Final = 256  # messages that wait for one viewer

_SILENT: Final = (Condition.OFFLINE, Condition.WAITING, Condition.STALLED, Condition.LOST, Condition.REFUSED)


async def serve(
    broker: Mqtt, listen: Listen, on_ready: Callable[[str], None], *, plate: str | None = None, full_rate: bool = True
) -> None:
    """Serve plates below the broker's prefix until SIGINT, SIGTERM or SIGHUP.

    Parameters
    ----------
    broker
        Where plates publish; it may come and go.
    listen
        Where viewers connect; port 0 selects a free one.
    on_ready
        Called with the address for viewers.
    plate
        The only one, whose channels then have the names of exported recordings; None: all of them, and the name of each
        goes before those of its channels.
    full_rate
        Whether to subscribe to all messages, or to the decimated topics.

    Raises
    ------
    ListenError
        The address is in use, or not this computer's.
    """
    serving = asyncio.create_task(_serve(broker, listen, on_ready, plate, full_rate))
    with on_signals(serving.cancel):
        await asyncio.wait([serving])
    if not serving.cancelled():
        serving.result()


class FoxgloveServer:
    """Server of channels to viewers, from `start` to `close`; a channel begins with its first message.

    Parameters
    ----------
    listen
        Where viewers connect; port 0 chooses a free one.
    prefixed
        Whether the name of its plate goes before each channel.
    """

    def __init__(self, listen: Listen, *, prefixed: bool) -> None:
        self._listen = listen
        self._prefixed = prefixed
        self._context = foxglove.Context()
        self._plates: dict[str, FoxgloveMessages] = {}
        self._channels: dict[str, Any] = {}
        self._names: dict[tuple[str, str], set[str]] = {}  # of the channels that messages of a plate and topic become
        self._drawn: dict[tuple[str, str], Message] = {}  # the latest of each stream
        self._last: dict[str, ChannelMessage] = {}  # of channels that change seldom

    def start(self) -> None:
        """Listen; called on the event loop."""
        try:
            self._server = foxglove.start_server(
                name="resonatord",
                host=self._listen.host,
                port=self._listen.port,
                context=self._context,
                server_listener=_Subscriptions(asyncio.get_running_loop(), self._repeat),
                message_backlog_size=BACKLOG_MAX,
            )
        except (RuntimeError, OSError) as error:
            raise ListenError(f"--listen {self._listen}: {error}; see who else has the port: ss -tlnp") from None

    @property
    def port(self) -> int:
        """Port that viewers connect to."""
        return int(self._server.port)

    def close(self) -> None:
        """Disconnect all viewers."""
        self._server.stop()

    def wants(self, plate: str, path: str) -> bool:
        """Return whether a message is of use: its channels are not known yet, a viewer has one, or it is lasting."""
        names = self._names.get((plate, path))
        return names is None or TOPICS[path].retained or any(self._channels[name].has_sinks() for name in names)

    def add(self, plate: str, path: str, message: Message) -> None:
        """Send what a message becomes to viewers that subscribe to it."""
        now_ns = time.time_ns()
        if plate not in self._plates:
            self._plates[plate] = FoxgloveMessages(plate, None)
        if isinstance(message, Info):
            self._plates[plate] = FoxgloveMessages(plate, Geometry.of_info(message))
            for made in self._plates[plate].of_plate(message.t_ns):
                self._send(plate, made, now_ns)
            for key in [key for key in self._names if key[0] == plate]:  # now that it can be drawn, there are more
                del self._names[key]
        names = [self._send(plate, made, now_ns) for made in self._plates[plate].of_message(path, message, now_ns)]
        self._names.setdefault((plate, path), set()).update(names)
        if isinstance(message, State) and message.state in _SILENT:
            self._clear(plate, now_ns)
        elif TOPICS[path].perishable:
            self._drawn[plate, path] = message

    def _clear(self, plate: str, now_ns: int) -> None:
        """Replace drawings of a plate that measures nothing: viewers would show the last ones for ever."""
        for name, path in [key for key in self._drawn if key[0] == plate]:
            for made in self._plates[plate].emptied(path, self._drawn.pop((name, path)), now_ns):
                self._send(plate, made, now_ns)

    def _send(self, plate: str, made: ChannelMessage, now_ns: int) -> str:
        name = f"{plate}/{made.channel}" if self._prefixed else made.channel
        if name not in self._channels:
            schema = foxglove.Schema(
                name=made.schema["title"], encoding="jsonschema", data=json.dumps(made.schema).encode()
            )
            self._channels[name] = foxglove.Channel(name, message_encoding="json", schema=schema, context=self._context)
        if made.lasting:
            self._last[name] = made
        if self._channels[name].has_sinks():
            self._channels[name].log(made.encode(), log_time=now_ns)
        return name

    def _repeat(self, channel: str) -> None:
        """Send the last message of a channel again, where it has one for new viewers."""
        if channel in self._last:
            self._channels[channel].log(self._last[channel].encode(), log_time=time.time_ns())


class _Subscriptions(ServerListener):  # type: ignore[misc]
    """Listener that the library calls in a thread of its own; reports subscriptions on the event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop, report: Callable[[str], None]) -> None:
        self._loop = loop
        self._report = report

    def on_subscribe(self, _client: Any, channel: Any) -> None:
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._report, channel.topic)


async def _serve(
    broker: Mqtt, listen: Listen, on_ready: Callable[[str], None], plate: str | None, full_rate: bool
) -> None:
    server = FoxgloveServer(listen, prefixed=plate is None)
    server.start()
    on_ready(f"ws://{Listen(listen.host, server.port)}")
    messages = subscribe(broker, plate=plate or EVERY_PLATE, full_rate=full_rate, wanted=server.wants)
    try:
        async with aclosing(messages) as received:
            async for name, path, message in received:
                server.add(name, path, message)
    finally:
        server.close()
