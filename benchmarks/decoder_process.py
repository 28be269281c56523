"""Decoder process of skin32 at a rate of frames: share decoded, age of maps, processor time on either side.

Run it with `python benchmarks/decoder_process.py [--rate 250] [--seconds 10] [--scene WORD]...`; scenes are those of
frame_cost.py. The age is that from the offer of a frame to the delivery of its map, without measuring and publishing.
Processor time is per offered frame: of the daemon's side, whose frames are made before, and of the whole child process,
rebuilds and encoding included. `loop` is the fixed piece of numpy of frame_cost.py.
"""

import argparse
import asyncio
import time
from typing import Any

import numpy as np
import psutil
from frame_cost import (
    DECIBEL,
    DEPTH_M,
    GAIN_ERROR,
    NU,
    PITCH_M,
    SCENES,
    SITES_M,
    YOUNGS_PASCAL,
    Load,
    Scene,
    reference_loop_ms,
    signals,
)

from resonator_daemon.decoder_process.supervisor import DecoderSupervisor
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.elastic import HalfSpace
from resonator_daemon.publishing.headers import MeasuredFields
from resonator_daemon.publishing.payloads import ContactEvent, Lost
from resonator_daemon.publishing.topics import DECODED, Topic
from resonator_daemon.reasons import Reason
from resonator_daemon.sensors.surface_stream import SurfaceFrame, SurfaceSettings

KEPT = 200  # frames that are played again and again, forwards and backwards


class Client:
    """Keeps the ages of maps."""

    def __init__(self) -> None:
        self.ages_ms: list[float] = []

    def deliver(self, origin: float, topic: Topic[Any], _message: Any) -> None:
        if topic is DECODED:
            self.ages_ms.append(1e3 * (time.monotonic() - origin))

    def deliver_event(self, origin: float, event: ContactEvent) -> None: ...

    def announce(self, note: Reason | None) -> None: ...

    def lost(self, _origin: float) -> Lost:
        return Lost()

    def contacts_header(self, _origin: float) -> MeasuredFields:
        return header(0)


def header(seq: int) -> MeasuredFields:
    return MeasuredFields(
        seq=seq,
        name="bench",
        daemon_boot_id="bench",
        t_ns=10**18,
        t_uncertainty_ns=0,
        lost=Lost(),
        board_ticks=seq,
    )


async def measure(scene: Scene, rate_hz: float, seconds: float) -> str:
    rng = np.random.default_rng(0)
    rms = float(np.sqrt(np.mean(signals([Load((0.0, 0.0), (0.0, 0.0, 1.0))]) ** 2)))
    noise_std = np.full((3, len(SITES_M)), rms * 10.0 ** (-DECIBEL / 20.0))
    gains = 1.0 + GAIN_ERROR * rng.standard_normal(noise_std.shape)
    frames = [
        signals(scene.loads(number)) * gains + noise_std * rng.standard_normal(noise_std.shape)
        for number in range(KEPT)
    ]
    order = [*range(KEPT), *range(KEPT - 1, -1, -1)]
    skin = Skin(HalfSpace(YOUNGS_PASCAL, NU), SITES_M, DEPTH_M)
    client = Client()
    settings = SurfaceSettings(
        skin, DecodingOptions(friction_coefficient=scene.friction_coefficient), np.arange(len(SITES_M)), PITCH_M
    )
    supervisor = DecoderSupervisor[float]("bench", settings, client)
    running = asyncio.create_task(supervisor.run())

    def offer(number: int) -> None:
        values = frames[order[number % len(order)]]
        supervisor.offer(time.monotonic(), SurfaceFrame(header(number), number, values, noise_std))

    while supervisor.decoded < KEPT // 4:
        offer(0)
        await asyncio.sleep(0.02)
    child = psutil.Process(supervisor.info().pid)
    client.ages_ms.clear()
    before, own_s, child_s = supervisor.decoded, time.thread_time(), sum(child.cpu_times()[:2])
    began = time.monotonic()
    count = round(rate_hz * seconds)
    for number in range(count):
        await asyncio.sleep(max(0.0, began + number / rate_hz - time.monotonic()))
        offer(number)
    await asyncio.sleep(0.1)
    own_us = 1e6 * (time.thread_time() - own_s) / count
    child_us = 1e6 * (sum(child.cpu_times()[:2]) - child_s) / count
    decoded = supervisor.decoded - before
    p50, p99 = np.percentile(client.ages_ms, (50, 99))
    running.cancel()
    await asyncio.wait([running])
    return f"{100 * decoded / count:6.1f} {p50:8.2f} {p99:8.2f} {own_us:12.0f} {child_us:10.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=100.0, help="frames a second")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each scene")
    parser.add_argument("--scene", action="append", default=[], help="part of a scene's name; default: all scenes")
    given = parser.parse_args()
    print(f"{given.rate:g} frames/s{'':22} % done   p50 ms   p99 ms  daemon's us  child's us")
    for name, scene in SCENES.items():
        if not scene.cold and (not given.scene or any(word in name for word in given.scene)):
            print(f"{name:32} {asyncio.run(measure(scene, given.rate, given.seconds))}", flush=True)
    print(f"loop: {reference_loop_ms():.3f} ms")


if __name__ == "__main__":
    main()
