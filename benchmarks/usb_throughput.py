"""Throughput and processor time of the USB link: transfers in flight at once against pyusb's one at a time.

Run it with `python benchmarks/usb_throughput.py [SECONDS]`. The device is emulated (umockdev) on the
same machine and bounds the figures: they compare ways of reading, not computers. Exit code 1 when a paced stream falls
behind.
"""

import os
import select
import subprocess
import sys
import time

from simulators.usb_link import UsbLink

FLAT_OUT = "flat out"
LOADS = (
    (FLAT_OUT, 16384, 0.0),
    ("quartz16", 204, 1000.0),
    ("skin32", 147_000, 100.0),
    ("skin32, fast", 147_000, 250.0),
)
READERS = ("8 in flight", "1 in flight", "pyusb")
MUST_KEEP_UP = {("quartz16", "8 in flight"), ("skin32", "8 in flight")}

_HOST = """
import sys, time
import usb.core
from resonator_daemon.links import usb_transfers
from resonator_daemon.links.usb_link import open_usb
from resonator_daemon.links.table import parse_link

reader, seconds = sys.argv[1], float(sys.argv[2])
if reader == "pyusb":
    device = usb.core.find(idVendor=0x1209, idProduct=0x0001)
    device.set_configuration()
    device.ctrl_transfer(0x41, 0x01, 1, 0)
    device.write(0x01, b"go")
    read = lambda: device.read(0x81, 16384, 5000)
else:
    usb_transfers.TRANSFERS = int(reader.split()[0])
    link = open_usb(parse_link("usb:1209:0001"))
    link.write(b"go")
    read = lambda: link.read(5.0)
size = len(read())
start, start_cpu = time.perf_counter(), time.process_time()
while (passed := time.perf_counter() - start) < seconds:
    size += len(read())
print(size / passed, (time.process_time() - start_cpu) / passed)
"""


def measure(reader: str, frame_bytes: int, rate_hz: float, seconds: float) -> tuple[float, float]:
    """Return bytes/s received and the host's share of a processor."""
    link = UsbLink("0042", lambda: None)
    host = subprocess.Popen(
        [sys.executable, "-c", _HOST, reader, f"{seconds}"],
        env={**os.environ, **link.environment},
        stdout=subprocess.PIPE,
        text=True,
    )
    frame = bytes(frame_bytes)
    unsent = memoryview(b"")
    begun_s: float | None = None
    frames = 0
    while host.poll() is None:
        due = begun_s is not None and (not rate_hz or frames < (time.monotonic() - begun_s) * rate_hz)
        if not unsent and due:
            unsent = memoryview(frame)
            frames += 1
        writers = [link.write_fd] if unsent else []
        readable, writable, _ = select.select(link.read_fds, writers, [], 0.2 / rate_hz if rate_hz else 0.05)
        if readable and link.read():
            begun_s = time.monotonic()
        if writable:
            unsent = unsent[link.write(unsent) :]
    received, _ = host.communicate()
    link.close()
    rate, share = received.split()
    return float(rate), float(share)


def main() -> int:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 4.0
    behind = []
    print(f"{'load':>14} {'reader':>12} {'wanted MB/s':>12} {'got MB/s':>10} {'host % of a core':>17}")
    for load, frame_bytes, rate_hz in LOADS:
        for reader in READERS:
            rate, share = measure(reader, frame_bytes, rate_hz, seconds)
            wanted = f"{frame_bytes * rate_hz * 1e-6:.3f}" if rate_hz else "-"
            print(f"{load:>14} {reader:>12} {wanted:>12} {rate * 1e-6:>10.3f} {share * 100:>17.1f}")
            if (load, reader) in MUST_KEEP_UP and rate < 0.98 * frame_bytes * rate_hz:
                behind.append(f"{load} with {reader}")
    if behind:
        print(f"fell behind: {', '.join(behind)}")
    return 1 if behind else 0


if __name__ == "__main__":
    sys.exit(main())
