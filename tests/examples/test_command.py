"""docs/examples/python/command.py asks a daemon and prints its answer."""

import json

from brokers import Mosquitto
from commanded import commanded, state
from example_programs import finished

from resonator_daemon.mqtt.topics import STATE_DAEMON
from resonator_daemon.mqtt.verbs import Ping, Pong


async def test_the_answer_is_printed_and_the_exit_code_shows_whether_it_was_done(mosquitto: Mosquitto) -> None:
    def pong(_: Ping) -> Pong:
        return Pong(t_ns=1, daemon_boot_id="first", uptime_s=2.5)

    async with commanded(mosquitto.url, {"ping": pong}) as left:
        left.publisher.publish(left.base, STATE_DAEMON, state("online", "measuring"))
        code, printed, _ = await finished("command", mosquitto.url, "left", "ping", '{"id": "mine"}')
        assert (code, json.loads(printed)["id"], json.loads(printed)["uptime_s"]) == (0, "mine", 2.5)
        code, _, reported = await finished("command", mosquitto.url, "left", "ping", '{"no": 1}')
        assert (code, reported.partition(":")[0], reported.count("\n")) == (1, "payload", 1)


async def test_a_broker_that_is_not_there_is_reported_in_one_line() -> None:
    code, _, reported = await finished("command", "mqtt://127.0.0.1:9", "left", "ping")
    assert (code, reported.count("\n")) == (1, 1)
    assert "127.0.0.1:9" in reported
