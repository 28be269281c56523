"""One and two decoder processes that share two skins of 32 x 32 sites: frames a second, processor time, and accounts.

Signals go through a broker at the skins' own rate, and then faster than decoders take them. Sender, broker, listener
and decoders share this computer: with two cores, two decoders have less than one each. Exit code 1 when a frame was
decoded twice, or one is missing that nobody counted.
"""

import argparse
import asyncio
import json
import os
import sys
import tempfile
import time
from asyncio.subprocess import DEVNULL
from collections import Counter, defaultdict
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import aiomqtt
import numpy as np
import psutil
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from resonator_daemon.decoding.skin import DecodingOptions
from resonator_daemon.decoding.streaming import set_up
from resonator_daemon.demo.processes import local_broker
from resonator_daemon.plate import Plate, load_plate
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.payloads import CalibrationInfo, GridInfo, Info, Lost, Signals, SiteInfo, SkinInfo
from resonator_daemon.publishing.topics import SCHEMA_VERSION
from resonator_daemon.remote_decoding.plate import RemotePlate, header_of
from resonator_daemon.sensors.surface_messages import SurfaceMessages
from simulators.contact import hertz_parts
from simulators.half_space_fields import hertz_fields

PLATES = ("left", "right")
OWN_HZ, FULL_HZ = 100.0, 400.0  # frames a second of each skin
SCENE = 100  # different frames: a press of 1 N that slides to and fro under some shear
NOISE_STD = np.array([[3e-3], [2e-3], [2e-3]])
SETTLED_S = 1.0
MEDIUM_M, SHEAR_NEWTON = 1.8e-3, 0.2
QUIET_S = 20.0


@dataclass
class Subscriber:
    """What a listener has counted."""

    decoded: Counter[tuple[str, int]] = field(default_factory=Counter)  # by plate and seq
    health: dict[str, Any] = field(default_factory=dict)  # the last of each decoder
    states: dict[str, str] = field(default_factory=dict)

    async def listen(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            _, name, *path = message.topic.value.split("/")
            content = json.loads(bytes(message.payload))
            if name != "decoder":
                self.decoded[name, content["seq"]] += 1
            elif path[-1] == "health":
                self.health[path[0]] = content
            else:
                self.states[path[0]] = content["state"]

    def total(self, key: str) -> int:
        return sum(plate[key] for health in self.health.values() for plate in health["plates"].values())


class Result(NamedTuple):
    """Of one run."""

    decoders: int
    rate_hz: float
    sent: int
    seconds: float
    decoded: int
    twice: int
    skipped: int
    unusable: int
    lost: int  # sent, and received by no decoder
    cpu_of_each: list[float]  # s
    cpu_of_broker: float

    def row(self) -> str:
        busy = sum(self.cpu_of_each)
        return (
            f"{self.decoders:8} {self.rate_hz * len(PLATES):8.0f} {self.sent / self.seconds:8.0f}"
            f" {self.decoded / self.seconds:9.1f} {1e3 * busy / max(self.decoded, 1):10.2f}"
            f" {'+'.join(f'{100 * cpu / self.seconds:.0f}' for cpu in self.cpu_of_each):>10}"
            f" {100 * self.cpu_of_broker / self.seconds:8.0f} {self.twice:6} {self.skipped:8} {self.unusable:8}"
            f" {self.lost:6}"
        )


HEADINGS = (
    f"{'decoders':>8} {'wanted/s':>8} {'sent/s':>8} {'decoded/s':>9} {'ms a frame':>10} {'CPU, %':>10} {'broker %':>8}"
    f" {'twice':>6} {'skipped':>8} {'unusable':>8} {'lost':>6}"
)


def header(seq: int) -> dict[str, Any]:
    return {
        "seq": seq,
        "name": "left-index",
        "daemon_boot_id": "9f3c52d0",
        "board_boot_id": None,
        "t_ns": time.time_ns(),
        "t_uncertainty_ns": 0,
        "lost": Lost(),
    }


def info_of(plate: Plate) -> Info:
    skin, grid = plate.skin, plate.grid
    if skin is None or grid is None:
        raise ValueError(f"plate {plate.name} has no grid under a skin")
    x, y = plate.site_positions_m[0].tolist()
    return Info(
        **header(0),
        schema_version=SCHEMA_VERSION,
        daemon_version="0",
        plate=plate.name,
        link="none",
        product="",
        serial_number=None,
        firmware="",
        counter="channelised",
        frame_rate_hz=OWN_HZ,
        window_s=1 / OWN_HZ,
        step_s=1 / OWN_HZ,
        rates_hz={},
        units={},
        commands=(),
        force_max_newton=plate.force_max_newton,
        outline_m=(),
        transducers_m=(),
        sites=tuple(
            SiteInfo(site=int(site), position_m=(float(place[0]), float(place[1])))
            for site, place in zip(plate.site_ids, plate.site_positions_m, strict=True)
        ),
        grid=GridInfo(origin_m=(x, y), pitch_m=grid.pitch_m, shape=grid.shape),
        skin=SkinInfo(
            youngs_modulus_pascal=skin.youngs_modulus_pascal,
            poisson_ratio=skin.poisson_ratio,
            depth_m=skin.depth_m,
            gain_std=skin.gain_std,
            correlation_length_m=skin.correlation_length_m,
            tangential_ratio=skin.tangential_ratio,
        ),
        calibration=CalibrationInfo(
            id=None, date=None, unit=None, expiry=None, model_error=0.0, sensitivity_std=0.0, response="off"
        ),
    )


def scene(plate: Plate) -> list[NDArray[np.float32]]:
    if plate.skin is None:
        raise ValueError(f"plate {plate.name} has no skin")
    rng, frames = np.random.default_rng(0), []
    modulus = plate.skin.youngs_modulus_pascal
    radii, forces = hertz_parts((SHEAR_NEWTON, 0.0, 1.0), MEDIUM_M, 0.5)
    for number in range(SCENE):
        centre_m = (2e-3 * np.sin(2 * np.pi * number / SCENE), 1e-3)
        fields = hertz_fields(
            plate.site_positions_m - centre_m, plate.skin.depth_m, radii, modulus, plate.skin.poisson_ratio
        )
        signals = np.einsum("kf,kfsn->sn", forces, fields) * np.array([[1.5 / modulus], [1.0], [1.0]])
        frames.append((signals + NOISE_STD * rng.standard_normal(signals.shape)).astype(np.float32))
    return frames


async def send(client: aiomqtt.Client, frames: list[NDArray[np.float32]], rate_hz: float, seconds: float) -> int:
    """Send frames of each plate at a rate, or as fast as that goes; return how many each had."""
    noise = np.broadcast_to(NOISE_STD.astype(np.float32), frames[0].shape).copy()
    loop = asyncio.get_running_loop()
    began_s, seq = loop.time(), 0
    while (passed_s := loop.time() - began_s) < seconds:
        if seq > passed_s * rate_hz:
            await asyncio.sleep(seq / rate_hz - passed_s)
        values = frames[seq % len(frames)]
        payload = encode(Signals(**header(seq), board_ticks=seq, signals=values, noise_std=noise, status="ok"))
        for plate in PLATES:
            await client.publish(f"resonator/{plate}/signals", payload)
        seq += 1
    return seq


@asynccontextmanager
async def decoder(config: Path) -> AsyncIterator[psutil.Process]:
    program = Path(sys.executable).with_name("resonatord")
    process = await asyncio.create_subprocess_exec(program, "decode", "--config", config, stderr=DEVNULL)
    try:
        yield psutil.Process(process.pid)
    finally:
        process.terminate()
        await process.wait()


def cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


async def until(predicate: Any) -> None:
    async with asyncio.timeout(QUIET_S):
        while not predicate():  # noqa: ASYNC110  what is waited for is in other processes
            await asyncio.sleep(0.05)


async def run(count: int, rate_hz: float, seconds: float, plate: Plate, frames: list[NDArray[np.float32]]) -> Result:
    with tempfile.TemporaryDirectory() as folder:
        async with AsyncExitStack() as stack:
            url = (await stack.enter_async_context(local_broker(Path(folder)))).url
            config = Path(folder) / "decoder.toml"
            config.write_text(f'[mqtt]\nurl = "{url}"\n[decoding]\nplates = ["+"]\ngroup = "touch"\n')
            host, port = urlsplit(url).hostname or "", urlsplit(url).port or 1883
            listener = await stack.enter_async_context(aiomqtt.Client(host, port))
            sender = await stack.enter_async_context(aiomqtt.Client(host, port, max_queued_outgoing_messages=0))
            for topic in ("resonator/+/decoded/summary", "resonator/decoder/+/health", "resonator/decoder/+/state"):
                await listener.subscribe(topic)
            subscriber = Subscriber()
            listening = asyncio.create_task(subscriber.listen(listener))
            stack.callback(listening.cancel)
            for name in PLATES:
                await sender.publish(f"resonator/{name}/info", encode(info_of(plate)), qos=1, retain=True)
            processes = [await stack.enter_async_context(decoder(config)) for _ in range(count)]
            await until(lambda: len(subscriber.health) == count)
            while subscriber.total("decoded") < 20 * count or set(subscriber.states.values()) != {"online"}:
                await send(sender, frames, OWN_HZ, 0.5)  # until all are set up
            await asyncio.sleep(SETTLED_S)
            subscriber.decoded.clear()
            before = {key: subscriber.total(key) for key in ("received", "decoded", "skipped", "unusable")}
            broker = next(child for child in psutil.Process().children() if child.name() == "mosquitto")
            used = [cpu_s(process) for process in processes]
            used_by_broker = cpu_s(broker)
            began_s = time.monotonic()
            sent = await send(sender, frames, rate_hz, seconds)
            took_s = time.monotonic() - began_s
            used = [cpu_s(process) - at_first for process, at_first in zip(processes, used, strict=True)]
            used_by_broker = cpu_s(broker) - used_by_broker
            while True:  # until nothing more comes
                last = subscriber.total("received")
                await asyncio.sleep(2.5)
                if subscriber.total("received") == last and not subscriber.total("waiting"):
                    break
            after = {key: subscriber.total(key) - before[key] for key in before}
            return Result(
                count,
                rate_hz,
                sent * len(PLATES),
                took_s,
                len(subscriber.decoded),
                sum(number - 1 for number in subscriber.decoded.values()),
                after["skipped"],
                after["unusable"],
                sent * len(PLATES) - after["received"],
                used,
                used_by_broker,
            )


def costs(plate: Plate, frames: list[NDArray[np.float32]]) -> None:
    """Print what one frame costs one core, and how large its messages are; processor time, whatever else runs."""
    noise = np.broadcast_to(NOISE_STD.astype(np.float32), frames[0].shape).copy()
    known = RemotePlate("left")
    known.read_info(encode(info_of(plate)))
    if known.skin is None:
        raise ValueError(str(known.problem))
    reporter = SurfaceMessages(
        known.skin.site_ids,
        known.skin.skin.site_positions_m,
        known.skin.grid.pitch_m if known.skin.grid else None,
        "bench",
    )
    noise_std = noise.astype(np.float64)
    alone = set_up(known.skin.skin, DecodingOptions(background=False), noise_std, ignore)
    following = set_up(known.skin.skin, DecodingOptions(), noise_std, ignore)
    still = (NOISE_STD * np.random.default_rng(1).standard_normal(frames[0].shape)).astype(np.float32)
    spent: defaultdict[str, list[float]] = defaultdict(list)
    sizes_bytes: dict[str, int] = {}
    for number, pressed in enumerate(frames):
        for touch, values in (("pressed", pressed), ("untouched", still)):
            payload = encode(Signals(**header(number), board_ticks=0, signals=values, noise_std=noise, status="ok"))
            started_s = time.thread_time()
            message = known.read_signals(payload, 0.0)
            if message is None:
                raise ValueError("a frame of this benchmark is none of its skin")
            signals = message.signals.astype(np.float64)
            spent["read"].append(time.thread_time() - started_s)
            started_s = time.thread_time()
            surface = alone.decode_alone(signals, noise_std)
            spent[f"decode on its own, {touch}"].append(time.thread_time() - started_s)
            started_s = time.thread_time()
            following.decode(signals, noise_std)
            spent[f"decode following, {touch}"].append(time.thread_time() - started_s)
            following.rebuild()
            started_s = time.thread_time()
            made = [
                reporter.decoded(header_of(message), surface.decoded),
                reporter.summary(header_of(message), surface),
            ]
            encoded = [encode(each) for each in made]
            spent["make messages"].append(time.thread_time() - started_s)
            sizes_bytes |= {"signals": len(payload), "decoded": len(encoded[0]), "decoded/summary": len(encoded[1])}
            if touch == "pressed":
                sizes_bytes["decoded/summary, pressed"] = len(encoded[1])
    for name, times_s in spent.items():
        print(
            f"{name:32} {1e3 * float(np.median(times_s)):7.2f} ms, 95 %: {1e3 * float(np.percentile(times_s, 95)):.2f}"
        )
    print("bytes:", ", ".join(f"{name} {size}" for name, size in sizes_bytes.items()))


def ignore(_step: str) -> None:
    pass


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each run")
    seconds = parser.parse_args().seconds
    plate = load_plate("skin32")
    frames = scene(plate)
    print(f"{os.cpu_count()} cores, shared by sender, broker, listener and decoders; {len(PLATES)} skins of 32 x 32")
    with threadpool_limits(1, user_api="blas"):
        costs(plate, frames)
    print(HEADINGS)
    results = []
    for rate_hz in (OWN_HZ, FULL_HZ):
        for count in (1, 2):
            results.append(asyncio.run(run(count, rate_hz, seconds, plate, frames)))
            print(results[-1].row(), flush=True)
    one, two = (result.decoded / result.seconds for result in results[-2:])
    print(f"two decoders decode {two / one:.2f} times as many frames as one")
    exact = all(result.sent == result.decoded + result.skipped + result.unusable + result.lost for result in results)
    print("every frame was decoded, skipped, unusable or lost" if exact else "the accounts do not balance")
    return 0 if exact and not any(result.twice for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
