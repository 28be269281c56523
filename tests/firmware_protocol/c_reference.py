"""The C reference, built with sanitizers and driven by lines of text (firmware_protocol/c/tests/driver.c)."""

import subprocess
import tempfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from shutil import which

import firmware_protocol.packets as packets_module
from firmware_protocol.messages import Description, Identity
from firmware_protocol.packets import Damage, ForeignVersion, Packet

C_FOLDER = Path(packets_module.__file__).with_name("c")
WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Wvla", "-Werror")
SANITIZERS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
CHUNK_BYTES = 68


def reference_sources() -> list[str]:
    return sorted(map(str, C_FOLDER.glob("resonator_*.c")))


def common_sources() -> list[str]:
    return sorted(map(str, (C_FOLDER / "common").glob("*.c")))


def compiler() -> str:
    """Return the path of the C compiler."""
    found = which("cc") or which("gcc")
    assert found, "the C reference needs a C compiler; on Debian, as root: apt-get install gcc libc6-dev"
    return found


def build(target: Path, *sources: str, options: tuple[str, ...] = SANITIZERS) -> Path:
    """Compile and link; warnings are errors, whose text is in the failure."""
    command = [compiler(), *WARNINGS, *options, "-I", str(C_FOLDER), *sources, "-o", str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="resonator-c-")


@cache
def driver(name: str, *sources: str, options: tuple[str, ...] = ()) -> Path:
    """Build a driver of `c/tests` with these sources and its own, once a process."""
    own = str(C_FOLDER / "tests" / f"{name}.c")
    return build(Path(_folder().name) / name, own, *sources, options=(*SANITIZERS, *options))


def run_driver(program: Path, commands: Iterable[str]) -> list[str]:
    """Return what the driver printed; a sanitizer's report is a failure."""
    done = subprocess.run([program], input="\n".join(commands) + "\n", capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.returncode, done.stderr[-4000:])
    return done.stdout.splitlines()


def run_commands(commands: list[str]) -> list[str]:
    """Run the driver of the reference alone."""
    return run_driver(driver("driver", *reference_sources()), commands)


def run_captures(commands: list[str]) -> list[str]:
    """Run the driver of `c/common`."""
    return run_driver(driver("capture_driver", *common_sources(), *reference_sources()), commands)


def hexadecimal(data: bytes) -> str:
    return data.hex() or "-"


def board_command(identity: Identity, description: Description, boot_id: int) -> str:
    """Return the command that makes this board; its queue is as long as the description says."""
    assert description.queue_bytes is not None
    numbers = (
        boot_id, identity.credit_bytes, description.queue_bytes // CHUNK_BYTES, description.counter_kind,
        description.tones, description.reference_millihertz, description.gate_ticks_min, description.gate_ticks_max,
        description.gate_ticks_step, description.oscillator_millihertz, description.oscillator_spacing_millihertz,
        description.capabilities, identity.reset_cause
    )  # fmt: skip
    texts = (identity.product, identity.serial_number, identity.firmware, description.plate)
    return " ".join(("board", *map(str, numbers), *(hexadecimal(text.encode()) for text in texts)))


def event_line(event: Packet | Damage | ForeignVersion) -> str:
    """Return the line that the driver prints for the same event."""
    if isinstance(event, Packet):
        line = f"packet {event.type} {event.sequence} {event.board_ticks} {event.boot_id} {event.payload.hex()}"
    elif isinstance(event, Damage):
        line = f"damage {event.defect.value} {event.size_bytes}"
    else:
        line = f"foreign {event.major} {event.type} {event.sequence}"
    return line
