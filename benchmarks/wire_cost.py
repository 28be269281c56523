"""What the wire costs: processor time from a port to frames, compared with a bare reader and another library's.

Run it with `python benchmarks/wire_cost.py [SECONDS]`. Exit code 1 when a figure is missed.
A child process sends, at its rate, what was made before; processor time is that of this process alone.
"""

import asyncio
import os
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

from emulated_board import emulated_board

from firmware_protocol.device import DeviceSession
from firmware_protocol.host import FramePart, HostSession
from firmware_protocol.layouts import CHANNEL_COUNT, TONE_STRUCT
from firmware_protocol.messages import Configuration, CounterKind, Description, Identity
from resonator_daemon.links.carriers.tcp import TcpTarget, open_tcp
from resonator_daemon.links.table import parse_link
from resonator_daemon.plate import load_plate
from resonator_daemon.session.board_reader import BoardReader
from resonator_daemon.session.frame_assembly import FrameAssembler

FRAME_RATE_HZ, SKIN_RATE_HZ = 1000, 250
SKIN_TONES = 3072
FRAMING_LIMIT, SKIN_LIMIT = 1.0, 40.0  # percent of a core

_SENDER = """
import os, sys, time
path, size, rate_hz, seconds, descriptor = sys.argv[1], *map(int, sys.argv[2:])
frames = open(path, "rb").read()
frames = [frames[at : at + size] for at in range(0, len(frames), size)]
start = time.monotonic()
for number in range(rate_hz * seconds):
    time.sleep(max(0.0, start + number / rate_hz - time.monotonic()))
    frame = memoryview(frames[number % len(frames)])
    while frame:
        frame = frame[os.write(descriptor, frame):]
"""


def running_session(kind: CounterKind, tones: int) -> tuple[HostSession, DeviceSession]:
    """Return both ends of a handshake that is done."""
    description = Description(kind, CHANNEL_COUNT, tones, 10**12, 1, 10**9, "bench")
    board, host = DeviceSession(Identity("bench", "0", "0", 0), description, 7), HostSession()
    for _ in range(2):
        host.receive(board.receive(host.data_to_send(), 0))
    host.configure(Configuration(1_000_000))
    for _ in range(2):
        host.receive(board.receive(host.data_to_send(), 0))
    return host, board


class Sender:
    """A child process that writes frames of one size at a rate."""

    def __init__(self, frames: list[bytes], rate_hz: int, seconds: int, descriptor: int) -> None:
        self._file = tempfile.NamedTemporaryFile()  # noqa: SIM115 - closed with the child
        self._file.write(b"".join(frames))
        self._file.flush()
        numbers = map(str, (len(frames[0]), rate_hz, seconds, descriptor))
        command = [sys.executable, "-c", _SENDER, self._file.name, *numbers]
        self._process = subprocess.Popen(command, pass_fds=[descriptor])

    def wait(self) -> None:
        self._process.wait()
        self._file.close()


def processor_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


async def over_a_terminal(frames: list[bytes], seconds: int, take: Callable[[bytes], object], library: bool) -> float:
    """Read a pseudo-terminal by add_reader, or by pyserial-asyncio; return the percentage of a core that took."""
    master, slave = os.openpty()
    tty.setraw(slave)
    loop = asyncio.get_running_loop()
    if library:
        import serial_asyncio

        class Reader(asyncio.Protocol):
            def data_received(self, data: bytes) -> None:
                take(data)

        transport, _ = await serial_asyncio.create_serial_connection(
            loop, Reader, os.ttyname(slave), baudrate=4_000_000
        )
        stop: Callable[[], object] = transport.close
    else:
        loop.add_reader(slave, lambda: take(os.read(slave, 1 << 16)))
        stop = lambda: loop.remove_reader(slave)  # noqa: E731
    sender = Sender(frames, FRAME_RATE_HZ, seconds + 1, master)
    await asyncio.sleep(0.8)
    before_s, began = processor_s(), time.monotonic()
    await asyncio.sleep(seconds - 0.5)
    percent = 100 * (processor_s() - before_s) / (time.monotonic() - began)
    await asyncio.to_thread(sender.wait)
    stop()
    await asyncio.sleep(0)
    os.close(master)
    os.close(slave)
    return percent


def skin_cost(seconds: int) -> tuple[float, int]:
    """Read large frames from a socket into arrays; return the percentage of a core, and frames that were complete."""
    host, board = running_session(CounterKind.CHANNELISED, SKIN_TONES)
    channel = bytes(range(256)) * (SKIN_TONES * TONE_STRUCT.size // 256)
    frames = [b"".join(board.frame_parts(n, 1_000_000 * n, [channel] * CHANNEL_COUNT)) for n in range(100)]
    listener = socket.create_server(("127.0.0.1", 0))
    link = open_tcp(TcpTarget("127.0.0.1", listener.getsockname()[1]))
    accepted, _ = listener.accept()
    sender = Sender(frames, SKIN_RATE_HZ, seconds, accepted.fileno())
    accepted.close()
    assembler, complete = FrameAssembler(SKIN_TONES), 0
    before_s, began = 0.0, 0.0
    while complete < SKIN_RATE_HZ * (seconds - 1):
        for event in host.receive(link.read(0.02)):
            if isinstance(event, FramePart):
                complete += sum(frame.parts_seen == frame.parts for frame in assembler.add([event]))
        if not began and complete >= SKIN_RATE_HZ // 2:
            before_s, began = processor_s(), time.monotonic()
    percent = 100 * (processor_s() - before_s) / (time.monotonic() - began)
    link.close()
    listener.close()
    sender.wait()
    return percent, complete


def reader_cost(seconds: int) -> float:
    """Return what the daemon's whole reader takes of a core: thread, clock, numbers, ring."""
    with tempfile.TemporaryDirectory() as folder, emulated_board("quartz16", Path(folder)) as (link, _):
        woken = threading.Event()
        reader = BoardReader(parse_link(link), load_plate("quartz16"), woken.set, step_frames=(5,))
        reader.start()
        while reader.counters().frames < 6 * FRAME_RATE_HZ:  # beyond the pings of the first seconds
            woken.wait(1.0)
            woken.clear()
            reader.pop_arrivals()
        before_s, began = processor_s(), time.monotonic()
        while time.monotonic() < began + seconds:
            woken.wait(1.0)
            woken.clear()
            reader.pop_arrivals()
        percent = 100 * (processor_s() - before_s) / (time.monotonic() - began)
        reader.stop()
    return percent


def main() -> int:
    seconds = int(sys.argv[1]) if len(sys.argv) > 1 else 6
    host, board = running_session(CounterKind.SINGLE_TONE, 1)
    frames = [board.frame(n, 1_000_000 * n, bytes(range(176))) for n in range(2000)]
    seen = []
    bare = asyncio.run(over_a_terminal(frames, seconds, len, library=False))
    framed = asyncio.run(
        over_a_terminal(frames, seconds, lambda data: seen.append(len(host.receive(data))), library=False)
    )
    print(f"{FRAME_RATE_HZ} frames/s of {len(frames[0])} bytes, percent of a core (add_reader unless said otherwise):")
    print(f"  reading alone                         {bare:5.1f}")
    print(f"  with framing and session              {framed:5.1f}   {sum(seen)} frames; at most {FRAMING_LIMIT:g} more")
    try:
        theirs = asyncio.run(over_a_terminal(frames, seconds, len, library=True))
        print(f"  pyserial-asyncio, reading alone       {theirs:5.1f}")
    except ImportError:
        print("  pyserial-asyncio is not installed: make bench installs it")
    print(f"  the daemon's reader, to stamped frames{reader_cost(seconds):6.1f}")
    skin, complete = skin_cost(seconds)
    print(
        f"skin32, {SKIN_RATE_HZ} frames/s of 147 kB, socket to arrays: {skin:.1f}, {complete} frames; "
        f"at most {SKIN_LIMIT:g}"
    )
    return int(framed - bare > FRAMING_LIMIT or skin > SKIN_LIMIT)


if __name__ == "__main__":
    sys.exit(main())
