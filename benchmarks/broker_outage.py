"""A broker that is killed in the middle of a run: no frame lost on input, and every message accounted for.

Run it with `make soak`, or `python benchmarks/broker_outage.py [SECONDS]`: a third of the time with a Mosquitto, a
third without, a third with a new one that remembers nothing. Exit code 1 when an account does not balance.
"""

import asyncio
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from resonator_daemon.config import load_config
from resonator_daemon.publishing.payloads import MessageAccount
from resonator_daemon.service import Service

_SAMPLE_S = 0.05


def start_mosquitto(port: int, folder: Path) -> "subprocess.Popen[bytes]":
    binary = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
    config = folder / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    return subprocess.Popen([binary, "-c", str(config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def balance(account: MessageAccount) -> int:
    """Return made less the sum of what became of it."""
    return account.made - (
        account.acknowledged
        + account.handed_to_socket
        + account.dropped
        + account.unknown_at_disconnect
        + account.waiting
    )


def start_emulator(folder: Path) -> "subprocess.Popen[bytes]":
    board = ("--plate", "quartz16", "--pty", str(folder / "board"))
    command = (sys.executable, "-m", "resonator_daemon.cli", "emulate", *board, "--json")
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


async def measure(seconds: float, folder: Path) -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    emulator = start_emulator(folder)
    assert emulator.stdout is not None  # noqa: S101 - it is a pipe
    link = json.loads(emulator.stdout.readline())["link"]
    path = folder / "board.toml"
    path.write_text(f'name = "soak"\nplate = "quartz16"\nlink = "{link}"\n[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n')
    service = Service(load_config(path))
    running = asyncio.create_task(service.run())
    broker = start_mosquitto(port, folder)
    worst, samples = 0, 0
    started = time.monotonic()
    killed = restarted = False
    while (elapsed := time.monotonic() - started) < seconds:
        if not killed and elapsed > seconds / 3:
            broker.kill()
            broker.wait()
            killed = True
            print(f"{elapsed:5.1f} s  broker killed     {service.message_account}", flush=True)
        if not restarted and elapsed > 2 * seconds / 3:
            print(f"{elapsed:5.1f} s  broker restarted  {service.message_account}", flush=True)
            broker = start_mosquitto(port, folder)
            restarted = True
        worst = max(worst, abs(balance(service.message_account)))
        samples += 1
        await asyncio.sleep(_SAMPLE_S)
    service.stop()
    await running
    broker.kill()
    broker.wait()
    emulator.terminate()
    report = json.loads(emulator.stdout.read().splitlines()[-1])
    emulator.wait()
    account, link_account = service.message_account, service.link_account
    worst = max(worst, abs(balance(account)))
    print(f"  end    {account}")
    print(f"frames on input: {link_account.frames}, lost {link_account.lost.total}; board made {report['frames_made']}")
    print(f"made = acknowledged + handed to socket + dropped + unknown + waiting: off by {worst} in {samples} samples")
    return 1 if worst or link_account.lost.total or account.waiting else 0


def main() -> int:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 90.0
    with tempfile.TemporaryDirectory() as folder:
        return asyncio.run(measure(seconds, Path(folder)))


if __name__ == "__main__":
    sys.exit(main())
