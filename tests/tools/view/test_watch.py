"""`resonatord watch` as it is used: in a terminal, in a pipe, as JSON, with and without a broker; ended by signals."""

import asyncio
import json
import math
import os
import pty
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import numpy as np
import pytest
from view_messages import NOW_NS, S, contacts, decoded, forces, info, site_force, state

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import topics
from resonator_daemon.mqtt.codec import Outgoing, encode
from resonator_daemon.mqtt.payloads import Signals
from resonator_daemon.mqtt.publisher import Publisher
from resonator_daemon.tools.view.watch import json_line

LEFT = "resonator/left"
COMMAND = (sys.executable, "-m", "resonator_daemon.commands", "watch")
TIMEOUT_S = 30


@asynccontextmanager
async def watching(*options: str, stdout: int = PIPE) -> AsyncIterator[Process]:
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", "LINES": "30"}
    process = await asyncio.create_subprocess_exec(*COMMAND, *options, stdout=stdout, stderr=PIPE, env=environment)
    try:
        async with asyncio.timeout(TIMEOUT_S):
            yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


@asynccontextmanager
async def plate(url: str) -> AsyncIterator[Publisher]:
    """A plate "left" that said who it is, and is silent since."""
    will = Outgoing(f"{LEFT}/state/daemon", encode(state("offline")), retained=True)
    publisher = Publisher(Mqtt(url=url), identifier="left", make_will=lambda: will)
    publisher.publish(LEFT, topics.STATE_DAEMON, state("online"))
    publisher.publish(LEFT, topics.INFO, info({7: (0.0, 0.0)}))
    running = asyncio.create_task(publisher.run())
    yield publisher
    await publisher.close()
    await running


@asynccontextmanager
async def pressed_plate(url: str) -> AsyncIterator[None]:
    """A plate "left" that publishes contacts 20 times a second."""

    async def press(publisher: Publisher) -> None:
        for seq in range(10_000):
            at = {"seq": seq, "t_ns": NOW_NS + seq * S // 20}
            publisher.publish(LEFT, topics.CONTACTS, contacts(7, 1.234).model_copy(update=at))
            await asyncio.sleep(0.05)

    async with plate(url) as publisher:
        pressing = asyncio.create_task(press(publisher))
        yield
        pressing.cancel()
        await asyncio.wait([pressing])


async def end(process: Process, number: signal.Signals) -> str:
    """End the process by a signal; return what it said on stderr."""
    process.send_signal(number)
    _, printed = await process.communicate()
    assert process.returncode == 0
    return printed.decode()


async def test_in_a_pipe_it_prints_a_line_a_plate(mosquitto) -> None:
    async with pressed_plate(mosquitto.url), watching("--url", mosquitto.url) as process:
        async for line in process.stdout:
            if b"at site 7 1.234 N" in line:
                break
        assert line.decode().startswith("left: daemon online   link unknown   sensor unknown; contact ")
        assert "Traceback" not in await end(process, signal.SIGTERM)


async def test_json_is_one_object_a_line(broker) -> None:
    heard = {}

    async def hear(process: Process, *paths: str) -> None:
        while set(paths) - heard.keys():
            line = json.loads(await process.stdout.readline())
            assert set(line) == {"plate", "topic", "message"}
            assert line["plate"] == "left"
            heard[line["topic"]] = line["message"]

    async with plate(broker.url) as publisher, watching("--url", broker.url, "--json") as process:
        await hear(process, "state/daemon", "info")
        publisher.publish(LEFT, topics.FORCES, forces(site_force(7, 1.234)))
        await hear(process, "forces")
        assert "Traceback" not in await end(process, signal.SIGINT)
    assert heard["forces"]["sites"][0]["force_newton"] == 1.234
    assert heard["state/daemon"]["state"] == "online"
    assert heard["info"]["t_ns"] == "1789000000000000000"


async def test_streams_come_as_often_as_people_follow(mosquitto) -> None:
    async with plate(mosquitto.url) as publisher, watching("--url", mosquitto.url, "--json") as process:
        while json.loads(await process.stdout.readline())["topic"] != "info":
            pass
        for seq, later_s in ((1, 0.0), (2, 0.02), (3, 0.04), (4, 0.06)):
            at = {"seq": seq, "t_ns": NOW_NS + round(later_s * S)}
            publisher.publish(LEFT, topics.FORCES, forces(site_force(7, 1.0), **at))
        lines = [json.loads(await process.stdout.readline()) for _ in range(2)]
    assert [line["message"]["seq"] for line in lines if line["topic"] == "forces"] == [1, 4]


@pytest.mark.parametrize("form", [("--json",), ()])
async def test_it_ends_quietly_when_the_reader_leaves(mosquitto, form: tuple[str, ...]) -> None:
    async with pressed_plate(mosquitto.url):
        reading, writing = os.pipe()
        async with watching("--url", mosquitto.url, *form, stdout=writing) as process:
            os.close(writing)
            await asyncio.to_thread(os.read, reading, 1)
            os.close(reading)
            _, printed = await process.communicate()
            assert process.returncode == 0
            assert b"Traceback" not in printed
            assert b"BrokenPipe" not in printed


async def test_page_in_a_terminal_waits_shows_and_restores_the_terminal(mosquitto) -> None:
    terminal, slave = pty.openpty()
    async with watching("--url", mosquitto.url, stdout=slave) as process:
        os.close(slave)
        screen = Screen(terminal)
        await screen.until(lambda text: "connected, MQTT 5" in text and "waiting for a plate" in text)
        assert screen.text.startswith("\x1b[?1049h")  # the alternate screen
        async with pressed_plate(mosquitto.url):
            await screen.until(lambda text: "tcp://127.0.0.1:5555" in text and "1.234 N ± 0.6 ± 12 mN" in text)
            await mosquitto.kill()
            await screen.until(lambda text: text.count("trying again") > 0)
            await mosquitto.start()
        process.terminate()
        await screen.until(lambda text: "\x1b[?1049l" in text)  # back from the alternate screen
        assert screen.text.rindex("\x1b[?25h") > screen.text.rindex("\x1b[?25l")  # with a cursor
        _, printed = await process.communicate()
        assert process.returncode == 0
        assert printed == b""
    os.close(terminal)


class Screen:
    """What a program writes to its terminal."""

    def __init__(self, terminal: int) -> None:
        self._terminal = terminal
        self.text = ""

    async def until(self, predicate: Callable[[str], bool]) -> None:
        while not predicate(self.text):
            self.text += (await asyncio.to_thread(os.read, self._terminal, 65536)).decode(errors="replace")


def test_json_line_has_arrays_as_lists_and_null_for_what_is_not_known() -> None:
    surface = np.arange(3 * 2 * 2, dtype=float).reshape(3, 2, 2)
    surface[0, 1, 0] = math.nan
    line = json_line("left", "decoded", decoded(surface))
    assert line.endswith("}\n")
    assert line.count("\n") == 1
    message = json.loads(line, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))["message"]
    assert message["traction_pascal"] == [[[0, 1], [None, 3]], [[4, 5], [6, 7]], [[8, 9], [10, 11]]]
    assert message["displacement_m"] is None
    assert message["t_ns"] == "1789000000000000000"
    header = {key: value for key, value in decoded(surface) if key in Signals.model_fields}
    line = json_line(
        "left",
        "signals",
        Signals(**header, signals=np.float32([[0.5, math.nan]] * 3), noise_std=np.full((3, 2), 1e-4), status="ok"),
    )
    assert json.loads(line)["message"]["signals"] == [[0.5, None]] * 3
    line = json_line("left", "forces", forces(site_force(7, math.nan)))
    assert json.loads(line)["message"]["sites"][0]["force_newton"] is None
