"""The subscribers of docs/examples, in C and in Python, print what was published, whatever MQTT the broker speaks."""

import math
import signal
from asyncio.subprocess import Process
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from brokers import Amqtt, Mosquitto, client_of
from example_programs import LANGUAGES, next_line, running
from published import decoded, event, force, forces, publish

from resonator_daemon.base.arrays import Floats
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import Grid

BEHIND_MESSAGES = 3000  # beyond what sockets hold and the broker keeps


@pytest.fixture
async def another(broker, tmp_path: Path) -> AsyncIterator[Amqtt | Mosquitto]:
    """A second broker of the same kind: amqtt takes clients without a name, as the examples are, for one."""
    (tmp_path / "another").mkdir()
    async with Amqtt() if isinstance(broker, Amqtt) else Mosquitto(tmp_path / "another") as another:
        yield another


def plate(language: str) -> str:
    """Return what a program prints before the topic of a plate."""
    return {"c": "resonator/left", "python": "left"}[language]


@pytest.mark.parametrize("language", LANGUAGES)
async def test_forces_and_decoded(broker, another, language: str) -> None:
    """Both at once: a program in C waits five seconds for a broker that does not know its MQTT."""
    random = np.random.default_rng(7)
    on_grid, scattered = random.normal(size=(3, 4, 5)) * 1e3, random.normal(size=(3, 7)) * 1e3
    scattered[2, 0] = math.nan
    await publish(broker.url, "forces", forces(1, force(7, 1.234), force(12, math.nan, "overload")))
    await publish(broker.url, "contacts/event", event(1, "onset"))
    await publish(another.url, "decoded", decoded(5, on_grid, Grid(origin_m=(-0.0012, 0.0034), pitch_m=4e-4)))
    async with (
        running(language, "forces", broker.url) as of_forces,
        running(language, "decoded", another.url) as of_decoded,
    ):
        await check_forces(of_forces, broker.url, language)
        await check_decoded(of_decoded, another.url, language, on_grid, scattered)
        await check_that_nothing_known_ends_nothing(of_decoded, another.url, language)


async def check_forces(program: Process, url: str, language: str) -> None:
    at, when = plate(language), "t_ns 1789000000000000123"
    at_first = {await next_line(program) for _ in range(3)}  # events have a connection of their own
    assert at_first == {
        f"{at}/forces {when} site 7 1.234 N ok",
        f"{at}/forces {when} site 12 nan N overload",
        f"{at}/contacts/event {when} onset contact 12 site 7",
    }
    await publish(url, "forces", forces(2))
    await publish(url, "forces", forces(3, force(3, -0.5)))
    assert await next_line(program) == f"{at}/forces {when} site 3 -0.5 N ok"


async def check_decoded(program: Process, url: str, language: str, on_grid: Floats, scattered: Floats) -> None:
    words = (await next_line(program)).replace(",", "").split()
    await publish(url, "decoded", decoded(2**40, scattered, None))
    last = (await next_line(program)).split()
    row, column = np.unravel_index(on_grid[2].argmax(), (4, 5))
    assert words[:4] == [f"{plate(language)}/decoded", "seq", "5", "peak"]
    numbers = [float(word) for word in (words[4], *words[7:9], *words[12:15])]
    place_m = (-0.0012 + 4e-4 * column, 0.0034 + 4e-4 * row)
    net_newton = on_grid.sum(axis=(1, 2)) * 4e-4**2
    np.testing.assert_allclose(numbers, [on_grid[2].max(), *place_m, *net_newton], rtol=1e-5)
    assert last[:4] == [f"{plate(language)}/decoded", "seq", str(2**40), "peak"]
    assert float(last[4]) == pytest.approx(np.nanmax(scattered[2]), rel=1e-5)
    assert last[5:] == ["Pa", "at", "point", str(np.nanargmax(scattered[2]))]


async def check_that_nothing_known_ends_nothing(program: Process, url: str, language: str) -> None:
    nothing = np.full((3, 4, 5), math.nan)
    await publish(url, "decoded", decoded(5, nothing, Grid(origin_m=(0.0, 0.0), pitch_m=4e-4)))
    assert await next_line(program) == f"{plate(language)}/decoded seq 5 nothing known"
    await publish(url, "decoded", decoded(6, nothing[:, 0], None))
    assert await next_line(program) == f"{plate(language)}/decoded seq 6 nothing known"
    await publish(url, "decoded", decoded(7, np.ones((3, 7)), None))
    assert await next_line(program) == f"{plate(language)}/decoded seq 7 peak 1 Pa at point 0"


@pytest.mark.parametrize("language", LANGUAGES)
async def test_a_restart_of_the_broker_is_survived(mosquitto, language: str) -> None:
    await publish(mosquitto.url, "forces", forces(1, force(7, 1.0)))
    async with running(language, "forces", mosquitto.url) as program:
        assert "site 7 1" in await next_line(program)
        await mosquitto.kill()
        await mosquitto.start()
        await publish(mosquitto.url, "forces", forces(2, force(8, 2.0)))
        assert "site 8 2" in await next_line(program)


@pytest.mark.parametrize("language", LANGUAGES)
async def test_events_arrive_while_streams_are_behind(mosquitto, language: str) -> None:
    """Mosquitto keeps 1000 packets for a connection whose reader is behind, and drops what comes then, QoS 1 too."""
    await publish(mosquitto.url, "forces", forces(1, force(7, 1.0)))
    await publish(mosquitto.url, "contacts/event", event(1, "onset"))
    async with running(language, "forces", mosquitto.url) as program, client_of(mosquitto.url) as daemon:
        assert len({await next_line(program) for _ in range(2)}) == 2  # both are subscribed
        program.send_signal(signal.SIGSTOP)
        padded = encode(forces(2))[:-1] + b', "padding": "' + 16_000 * b"x" + b'"}'
        for _ in range(BEHIND_MESSAGES):
            await daemon.publish("resonator/left/forces", padded)
        await daemon.publish("resonator/left/contacts/event", encode(event(2, "release")), qos=1)
        program.send_signal(signal.SIGCONT)
        assert " release contact 12 " in await next_line(program)
