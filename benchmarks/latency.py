"""How long after the end of its window a subscriber has a message, of quartz16 and skin32 over Mosquitto.

Run it with `python benchmarks/latency.py [--plate NAME]... [--seconds N] [--json]`. Emulated board, daemon and broker
are processes of their own. A latency ends when a thread of this process has read the message; the truth is read
afterwards. Exit code 1 if a message is missing.
"""

import argparse
import asyncio
import gc
import io
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import cbor2
import numpy as np

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.config.tables import Measurement
from resonator_daemon.mqtt.broker_connection import MQTT_3
from resonator_daemon.mqtt.subscriber import Arrival, Receiver
from resonator_daemon.mqtt.topics import DECODED, FORCES, full_topic
from resonator_daemon.tools.demo.processes import local_broker, raise_if_ended, start_daemon, start_emulator
from resonator_daemon.tools.demo.truth import TruthTable

LATE_MS = 20.0
HEAD_BYTES = 512  # of a message with arrays: `seq` and `board_ticks` are within
START_S, SETTLE_S = 120.0, 3.0  # a decoder is set up; caches are warm and the board's clock is known
PERIOD_S = 0.2


async def measure(plate_name: str, seconds: float) -> dict[str, Any]:
    plate = load_plate(plate_name)
    topic = DECODED if plate.decodable else FORCES
    arrivals: list[tuple[int, bytes]] = []

    def keep(arrival: Arrival) -> None:
        arrays = not arrival.payload.startswith(b"{")
        arrivals.append((arrival.arrived_ns, arrival.payload[:HEAD_BYTES] if arrays else arrival.payload))

    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="resonatord-latency-")))
        broker = await stack.enter_async_context(local_broker(folder))
        filters = {full_topic("resonator", plate_name, topic.path): 0}
        receiver = Receiver(Mqtt(url=broker.url), [filters], keep, version=MQTT_3)
        receiver.start()
        stack.push_async_callback(receiver.close)
        emulator = await start_emulator(plate_name, plate, folder)
        stack.push_async_callback(emulator.child.stop)
        daemon = await start_daemon(plate_name, emulator.link, broker.url, folder)
        stack.push_async_callback(daemon.stop)
        children = (broker.child, emulator.child, daemon)
        started = time.monotonic()
        while not arrivals and time.monotonic() < started + START_S:
            raise_if_ended(children)
            await asyncio.sleep(PERIOD_S)
        if not arrivals:
            sys.exit(f"{plate_name}: no message on {topic.path} within {START_S:g} s")
        await asyncio.sleep(SETTLE_S)
        gc.freeze()
        first = len(arrivals)
        before_s = {child.part: child.cpu_s() for child in children}
        await asyncio.sleep(seconds)
        counted = arrivals[first:]
        used_s = {child.part: child.cpu_s() - before_s[child.part] for child in children}
        raise_if_ended(children)
        await daemon.stop()
        await emulator.child.stop()  # upon which the truth is written in full
        frames_apart = 1 if topic is DECODED else round(Measurement().step_s * plate.counter.frame_rate_hz)
        return {
            "plate": plate_name,
            "topic": topic.path,
            "broker": broker.name,
            "seconds": seconds,
            **latencies(counted, emulator.truth, frames_apart),
            "cpu_percent_by_part": {part: round(100 * part_s / seconds, 1) for part, part_s in used_s.items()},
        }


def latencies(arrivals: Sequence[tuple[int, bytes]], truth_file: Path, frames_apart: int) -> dict[str, Any]:
    """Match messages with the gates that they describe; `frames_apart` is from one message to the next."""
    truth = TruthTable(truth_file)
    truth.read_on()
    truth.close()
    milliseconds, numbers, gates = [], [], []
    for arrived_ns, head in arrivals:
        seq, board_ticks = seq_and_ticks(head)
        (line,) = truth.window(board_ticks, 1) or sys.exit(f"the truth has no gate that ends at {board_ticks}")
        milliseconds.append((arrived_ns - line.t_ns) * 1e-6)
        numbers.append(seq)
        gates.append(line.sequence)
    published = numbers[-1] - numbers[0] + 1
    p50, p99, largest = np.quantile(milliseconds, [0.5, 0.99, 1.0]).round(3).tolist()
    return {
        "latency_ms": {"p50": p50, "p99": p99, "max": largest},
        "messages": len(arrivals),
        "late": sum(latency_ms > LATE_MS for latency_ms in milliseconds),
        "not_received": published - len(arrivals),
        "not_published": (gates[-1] - gates[0]) // frames_apart + 1 - published,
    }


def seq_and_ticks(head: bytes) -> tuple[int, int]:
    """Read JSON, which is whole, or CBOR, which may be cut off."""
    if head.startswith(b"{"):
        message = json.loads(head)
        return message["seq"], int(message["board_ticks"])
    decoder = cbor2.CBORDecoder(io.BytesIO(head[1:]))  # behind the head of a map of up to 23 pairs of key and value
    found: dict[str, Any] = {}
    while "board_ticks" not in found:
        key = decoder.decode()
        found[key] = decoder.decode()
    return found["seq"], found["board_ticks"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--plate", action="append", choices=("quartz16", "skin32"), help="default: both, in turns")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", action="store_true", help="print one JSON object a plate, and nothing else")
    arguments = parser.parse_args()
    missing = 0
    for plate_name in arguments.plate or ("quartz16", "skin32"):
        result = asyncio.run(measure(plate_name, arguments.seconds))
        missing += result["not_received"] + result["not_published"]
        if arguments.json:
            print(json.dumps(result), flush=True)
            continue
        print("{plate}, {topic}: {seconds:g} s, broker {broker}".format_map(result))
        print("p50 {p50:g} ms, p99 {p99:g} ms, max {max:g} ms".format_map(result["latency_ms"]))
        print("{messages} messages, {late} over 20 ms, {not_received} not received".format_map(result), end=", ")
        print("{not_published} not published".format_map(result))
        parts = ", ".join(f"{part} {percent:g}" for part, percent in result["cpu_percent_by_part"].items())
        print(f"% of a processor: {parts}\n")
    return int(missing > 0)


if __name__ == "__main__":
    sys.exit(main())
