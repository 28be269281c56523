"""A daemon measures emulated plates; the C programs print what it publishes, with nothing else in between."""

import json
import math
from asyncio.subprocess import Process
from pathlib import Path

import cbor2
import numpy as np
from example_programs import next_line, running
from observer import observe
from service_bench import Bench

LINES = 20


async def lines_of(program: Process) -> list[str]:
    return [await next_line(program) for _ in range(LINES)]


async def test_forces_of_an_emulated_plate(tmp_path: Path, mosquitto) -> None:
    bench, topic = Bench(tmp_path, mosquitto.url), "resonator/hand/forces"
    async with (
        observe(mosquitto.url, topic) as heard,
        running("c", "forces", mosquitto.url) as program,
        bench.emulated(),
        bench.running(bench.service()),
    ):
        printed = await lines_of(program)
        last_t_ns = printed[-1].split()[2].encode()
        await heard.until(lambda: any(last_t_ns in payload for payload in heard.raw(topic)))
    published = {
        f"{topic} t_ns {message['t_ns']} site {site['site']} {force_newton:.6g} N {site['status']}"
        for message in map(json.loads, heard.raw(topic))
        for site in message["sites"]
        for force_newton in (math.nan if site["force_newton"] is None else site["force_newton"],)
    }
    assert set(printed) <= published
    assert any(line.endswith(" ok") for line in printed)


async def test_the_surface_of_an_emulated_skin(tmp_path: Path, mosquitto) -> None:
    bench, topic = Bench(tmp_path, mosquitto.url), "resonator/hand/decoded"
    async with (
        observe(mosquitto.url, topic) as heard,
        running("c", "decoded", mosquitto.url) as program,
        bench.emulated("skin32") as emulator,
        bench.running(bench.service("skin32", emulator.link.address)),
    ):
        printed = [line.replace(",", "").split() for line in await lines_of(program)]
        await heard.until(lambda: cbor2.loads(heard.raw(topic)[-1])["seq"] >= int(printed[-1][2]))
    frames = {message["seq"]: message for message in map(cbor2.loads, heard.raw(topic))}
    for words in printed:
        message = frames[int(words[2])]
        shape, numbers = message["traction_pascal"].value
        traction, grid = np.frombuffer(numbers.value, "<f4").reshape(shape).astype(float), message["grid"]
        row, column = np.unravel_index(traction[2].argmax(), shape[1:])
        place_m = np.array(grid["origin_m"]) + np.array([column, row]) * grid["pitch_m"]
        net_newton = traction.sum(axis=(1, 2)) * grid["pitch_m"] ** 2
        said = [float(word) for word in (words[4], *words[7:9], *words[12:15])]
        np.testing.assert_allclose(said, [traction[2].max(), *place_m, *net_newton], rtol=1e-5, atol=1e-12)
