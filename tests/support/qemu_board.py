"""The board program of firmware_protocol/c/mps2_an385, built for a Cortex-M3 and run under QEMU."""

import json
import secrets
import socket
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Self

import psutil

SOURCES = Path(__file__).parents[2] / "firmware_protocol" / "c" / "mps2_an385"
SERIAL_NUMBER = "FW-0001"

_RANDOM_WORD = 0x2000FFFC  # where link.ld has the random number that hardware would draw
_LEDS = 0x40028000


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def build(folder: Path) -> Path:
    """Compile into `folder`; return the program. RuntimeError has what is missing, or the output of the compiler."""
    try:
        made = subprocess.run(
            ["make", "--silent", "-C", str(SOURCES), f"BUILD={folder.resolve()}"], capture_output=True, text=True
        )
    except FileNotFoundError as error:
        raise RuntimeError("make is not installed; as root: apt-get install make") from error
    if made.returncode:
        raise RuntimeError(f"the board program was not built (apt-get install gcc-arm-none-eabi?):\n{made.stderr}")
    return folder / "board.elf"


class QemuBoard:
    """An emulated board that is switched on and off, as often as wanted, on the same port.

    Parameters
    ----------
    program
        What `build` returned.
    tcp_port
        Where on 127.0.0.1 its UART listens, or else
    pty
        the symbolic link that is made to its pseudo-terminal.
    """

    def __init__(self, program: Path, *, tcp_port: int | None = None, pty: Path | None = None) -> None:
        self._program = program
        self._pty = pty
        self._serial = f"tcp:127.0.0.1:{tcp_port},server=on,wait=off" if pty is None else "pty"
        self._running: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        self.power_on()
        return self

    def __exit__(self, *_: object) -> None:
        self.power_off()

    def power_on(self) -> None:
        """Start; returns when the port is there."""
        random_word = secrets.randbits(32)
        self._running = subprocess.Popen(
            [
                *("qemu-system-arm", "-M", "mps2-an385", "-kernel", str(self._program)),
                *("-display", "none", "-monitor", "none", "-qmp", "stdio", "-serial", self._serial),
                *("-device", f"loader,addr={_RANDOM_WORD:#x},data={random_word:#x},data-len=4"),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._next_answer()  # the greeting: ports are open by then
        self._ask("qmp_capabilities")
        if self._pty is not None:
            devices = self._ask("query-chardev")
            name = next(device["filename"] for device in devices if device["filename"].startswith("pty:"))
            self._pty.unlink(missing_ok=True)
            self._pty.symlink_to(name.removeprefix("pty:"))

    def power_off(self) -> None:
        """Kill it at any moment."""
        if self._running is None:
            return
        if self._pty is not None:
            self._pty.unlink(missing_ok=True)
        self._running.kill()
        with suppress(BrokenPipeError):
            self._running.communicate()
        self._running = None

    def reset(self) -> None:
        """Press the reset button: the port stays."""
        self._ask("system_reset")

    def led_is_on(self) -> bool:
        """Return whether LED 0 is on."""
        memory = self._ask("human-monitor-command", **{"command-line": f"xp /1xw {_LEDS:#x}"})
        return bool(int(memory.split()[-1], 16) & 1)

    @property
    def processor_s(self) -> float:
        """Seconds of a processor that QEMU has used since it was switched on."""
        times = psutil.Process(self._process.pid).cpu_times()
        return float(times.user + times.system)

    @property
    def _process(self) -> subprocess.Popen[str]:
        if self._running is None:
            raise ValueError("the board is switched off")
        return self._running

    def _qmp(self, end: str) -> IO[str]:
        stream: IO[str] = getattr(self._process, end)
        return stream

    def _ask(self, command: str, **arguments: str) -> Any:
        self._qmp("stdin").write(json.dumps({"execute": command, "arguments": arguments}) + "\n")
        self._qmp("stdin").flush()
        answer = self._next_answer()
        while "event" in answer:
            answer = self._next_answer()
        return answer["return"]

    def _next_answer(self) -> dict[str, Any]:
        for line in self._qmp("stdout"):
            if line.startswith("{"):  # QEMU also prints the name of a pseudo-terminal
                answer: dict[str, Any] = json.loads(line)
                return answer
        raise RuntimeError(f"QEMU ended with code {self._process.wait()}")
