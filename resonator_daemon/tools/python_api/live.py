"""Messages of running daemons as they come, and commands to them."""

from collections.abc import AsyncGenerator, Collection
from contextlib import aclosing
from typing import Any

from resonator_daemon.base.errors import UsageError
from resonator_daemon.base.toml import nearest
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.requests import ANSWER_S, execute, find_online, find_plate, reach
from resonator_daemon.mqtt.subscriber import EVERY_PLATE, Received
from resonator_daemon.mqtt.subscriber import subscribe as subscribe_at
from resonator_daemon.mqtt.topics import TOPICS
from resonator_daemon.mqtt.verbs import Answer
from resonator_daemon.tools.command_line import broker_at, checked_name
from resonator_daemon.tools.python_api import readable_errors


async def subscribe(
    url: str | Mqtt, plate: str | None = None, topics: Collection[str] | str | None = None, *, full_rate: bool = True
) -> AsyncGenerator[Received]:
    """Yield the messages of a plate as they come, those that the broker retains first, for ever.

    Each item has `plate`, `path` (the topic below the plate, as `contacts/event`) and `message`, an object of the class
    that `docs/reference/mqtt-topics.md` describes. Units are in the names of its fields; arrays are NumPy arrays, and
    numbers that are not known are NaN. A broker that goes away is connected to again. States and events are all
    delivered; where the loop is slow, messages of streams older than 250 ms are dropped in favour of newer ones.

    >>> async for plate, path, message in resonatord.subscribe("mqtt://127.0.0.1:1883", "left-index", "forces"):
    ...     for force in message.sites:
    ...         print(force.site, force.force_newton, "N +-", force.noise_newton, "N", force.status)

    Parameters
    ----------
    url
        Broker, as `mqtt://127.0.0.1:1883`, `mqtts://` for TLS; or `Mqtt(url=..., prefix=..., username=...,
        password_file=..., ca_file=...)`.
    plate
        Its name; None: all plates of the broker.
    topics
        One or several of `state/daemon`, `state/link`, `state/sensor`, `info`, `contacts/event`, `forces`, `contacts`,
        `tones`, `signals`, `decoded`, `decoded/summary` and `health`; None: all.
    full_rate
        Whether streams come with every message; else those of 20 Hz (arrays: 5 Hz), as people can follow.

    Raises
    ------
    BrokerUnreachableError
        Nobody listens at the broker's address, when the subscription begins.
    NoDaemonError
        No daemon has ever published under the name of the plate.
    UserError
        An argument cannot be used.
    """
    with readable_errors():
        broker = _broker(url)
        wanted = tuple(TOPICS) if topics is None else (topics,) if isinstance(topics, str) else tuple(topics)
        for topic in wanted:
            if topic not in TOPICS:
                raise UsageError(f"topic {topic!r}: no plate has it; {nearest(topic, tuple(TOPICS))}")
        await reach(broker)
        if plate is not None:
            await find_plate(broker, checked_name(plate, "plate"))
    chosen = [TOPICS[topic] for topic in wanted]
    async with aclosing(subscribe_at(broker, chosen, plate=plate or EVERY_PLATE, full_rate=full_rate)) as messages:
        async for received in messages:
            yield received


async def command(
    url: str | Mqtt, plate: str, verb: str, /, *, timeout_s: float = ANSWER_S, **arguments: Any
) -> Answer:
    """Send a command to the daemon of a plate; return its answer once it was done.

    >>> answer = await resonatord.command("mqtt://127.0.0.1:1883", "left-index", "set_window", window_ms=20)
    >>> answer = asyncio.run(resonatord.command("mqtt://127.0.0.1:1883", "left-index", "ping"))  # outside coroutines
    >>> answer.uptime_s
    60.2

    Parameters
    ----------
    url
        Broker, as of `subscribe`.
    plate
        Its name.
    verb
        `ping`, `events`, `tare`, `start_recording`, `stop_recording`, `mark`, `set_window`
        or `identify`; `docs/reference/mqtt-commands.md` lists arguments and answers.
    timeout_s
        How long to wait for the answer.
    **arguments
        Those of the verb.

    Returns
    -------
    Answer
        An object of the verb's class, with its fields as attributes.

    Raises
    ------
    RefusedError
        The daemon did not do it; `code` states why, as `not_permitted` or `not_untouched`.
    BrokerUnreachableError, NoDaemonError, NoAnswerError
        Nobody listens at the broker's address; no daemon of this name is online; it did not answer in time.
    UserError
        An argument cannot be used.
    """
    with readable_errors():
        broker = _broker(url)
        await reach(broker)
        await find_online(broker, checked_name(plate, "plate"))
        return await execute(broker, plate, verb, arguments, answer_s=timeout_s)


def _broker(url: str | Mqtt) -> Mqtt:
    return url.with_name("url") if isinstance(url, Mqtt) else broker_at(url, Mqtt().prefix, named_by="url")
