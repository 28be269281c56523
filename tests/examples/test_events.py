"""docs/examples/python/events.py prints each event once and in order, whatever it missed."""

from asyncio.subprocess import Process
from itertools import pairwise

from brokers import Amqtt, Mosquitto, client_of
from commanded import commanded, state
from example_programs import next_line, running
from published import event
from relay import relay

from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.commands import CommandRefusedError, Handler
from resonator_daemon.mqtt.payloads import ContactEvent
from resonator_daemon.mqtt.topics import STATE_DAEMON
from resonator_daemon.mqtt.verbs import Events, EventsAnswer

PAGE = 3  # events in an answer


class Store:
    """Stored events by run, the last one the present, and the command that asks for them."""

    def __init__(self) -> None:
        self.runs: dict[str, list[ContactEvent]] = {"first": []}
        self.handlers: dict[str, Handler] = {"events": self.answer}

    def happen(self, boot_id: str) -> ContactEvent:
        run = self.runs.setdefault(boot_id, [])
        run.append(event(len(run), "onset").model_copy(update={"daemon_boot_id": boot_id}))
        return run[-1]

    def answer(self, request: Events) -> EventsAnswer:
        boot_id = request.daemon_boot_id or list(self.runs)[-1]
        if boot_id not in self.runs:
            raise CommandRefusedError("unknown_boot", "no such run")
        run = self.runs[boot_id]
        events = tuple(run[request.after_seq + 1 :][:PAGE])
        return EventsAnswer(
            daemon_boot_id=boot_id,
            events=events,
            complete=True,
            oldest_seq=0,
            newest_seq=len(run) - 1 if run else None,
            next_daemon_boot_id=dict(pairwise(self.runs)).get(boot_id),
        )


async def printed(program: Process, count: int) -> list[tuple[str, int]]:
    lines = [(await next_line(program)).split() for _ in range(count)]
    return [(line[0], int(line[1])) for line in lines]


async def test_each_event_is_printed_once(broker: Mosquitto | Amqtt) -> None:
    store = Store()
    for _ in range(4):
        store.happen("first")
    async with (
        commanded(broker.url, store.handlers) as left,
        relay(broker.url) as way,
        client_of(broker.url) as daemon,
        running("python", "events", way.url, "left") as program,
    ):

        async def publish(*events: ContactEvent) -> None:
            for each in events:
                await daemon.publish("resonator/left/contacts/event", encode(each), qos=1)

        left.publisher.publish(left.base, STATE_DAEMON, state("online", "measuring"))
        assert await printed(program, 4) == [("first", seq) for seq in range(4)]  # those of before
        now = store.happen("first")
        await publish(now, now)
        missed = store.happen("first"), store.happen("first")
        await publish(missed[1], missed[0], missed[1])
        assert await printed(program, 3) == [("first", 4), ("first", 5), ("first", 6)]
        for _ in range(5):
            store.happen("first")
        way.cut()
        assert await printed(program, 5) == [("first", seq) for seq in range(7, 12)]
        store.happen("first")
        store.happen("second")
        store.happen("third")
        await publish(store.happen("third"))
        assert await printed(program, 4) == [("first", 12), ("second", 0), ("third", 0), ("third", 1)]
