"""What arrives from the board program under QEMU at the daemon's reader, and what that costs.

Run it with `make test-firmware`, or `python benchmarks/firmware.py [SECONDS]` for each kind of port. Exit code 1 when
bytes or frames went wrong on the way; frames that the board gave up are those of a machine too slow for QEMU.
"""

import sys
import tempfile
import threading
import time
from pathlib import Path

from parts import free_port
from qemu_board import QemuBoard, build

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.links.carriers.tcp import TcpTarget
from resonator_daemon.board.session.board_reader import BoardReader
from resonator_daemon.board.session.frames import SingleToneFrame


def run(board: QemuBoard, link: SerialTarget | TcpTarget, seconds: float) -> tuple[bool, str]:
    """Return whether all went well on the way, and a line that tells of the run."""
    woken = threading.Event()
    reader = BoardReader(link, load_plate("quartz16"), woken.set)
    with board:
        reader.start()
        while not any(isinstance(arrival, SingleToneFrame) for arrival in reader.pop_arrivals()):
            woken.wait(1.0)
            woken.clear()
        begun_s, qemu_s, reader_s = time.monotonic(), board.processor_s, time.process_time()
        before = reader.counters()
        while time.monotonic() < begun_s + seconds:
            time.sleep(0.1)
            reader.pop_arrivals()
        account = reader.counters()
        elapsed_s = time.monotonic() - begun_s
        qemu = (board.processor_s - qemu_s) / elapsed_s
        here = (time.process_time() - reader_s) / elapsed_s
        reader.stop()
    frames = account.frames - before.frames
    given_up = account.lost.board_overflow - before.lost.board_overflow
    bad = account.lost.total - account.lost.board_overflow
    return bad == account.bytes_discarded == 0, (
        f"{frames / elapsed_s:6.1f} frames/s, {bad} bad, {account.bytes_discarded} bytes damaged, "
        f"{given_up} given up by the board; QEMU {qemu:.0%} of a core, reader {here:.0%}"
    )


def main() -> int:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    all_well = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = build(folder)
        port, pty = free_port(), folder / "board"
        for kind, board, link in (
            ("tcp", QemuBoard(program, tcp_port=port), TcpTarget("127.0.0.1", port)),
            ("pty", QemuBoard(program, pty=pty), SerialTarget(str(pty), 4_000_000)),
        ):
            well, line = run(board, link, seconds)
            print(f"{kind}: {line}", flush=True)
            all_well &= well
    return 0 if all_well else 1


if __name__ == "__main__":
    sys.exit(main())
