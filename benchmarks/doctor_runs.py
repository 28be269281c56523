"""Whether `resonatord doctor` sees each fault that an emulator and a broker can have, and none where all is well.

    .venv/bin/python benchmarks/doctor_runs.py [--healthy 20] [--seconds 2] [--only NAME]

Prints a table of what was asked and what was seen; exit code 1 where they differ.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from system_parts import free_port

COMMAND = (sys.executable, "-m", "resonator_daemon")
PLATES = Path(__file__).parents[1] / "resonator_daemon/plates"


@dataclass(frozen=True)
class Case:
    """A fault and what is to be seen of it: verdict, and id with outcome of one finding."""

    name: str
    verdict: str = "fine"
    seen: str = ""
    plate: str = "quartz16"
    emulator: tuple[str, ...] = ("--scenario", "still")
    scenario: str = ""  # of a file, in place of `still`
    moved: tuple[str, str] | None = None  # text of the plate file that is another on the board's side
    board: bool = True
    broker: str = "set_tcp_nodelay true\nallow_anonymous true"
    url: str = ""
    holder: bool = False


# That of the emulator's `thermal-shock`, at once: there it comes ten seconds after the start.
SHOCK = "environment_kelvin = [[0, 298.15], [5, 308.15]]\n[plate]\ncontact_time_s = 0.5\n"


def fault(name: str, verdict: str, seen: str, faults: str) -> Case:
    return Case(name, verdict, seen, emulator=("--scenario", "still", "--faults", faults))


CASES = (
    Case("no port", "wiring", "port.exists=fault", board=False),
    Case("port is held", "wiring", "port.holder=fault", holder=True),
    fault("bit errors", "wiring", "link.errors=fault", "bit_error_rate=1e-5"),
    fault("garbage", "wiring", "link.errors=fault", "garbage_rate_hz=50"),
    fault("lost bytes", "wiring", "link.errors=fault", "lost_chunk_rate_hz=10,lost_chunk_bytes=400"),
    fault("rare damage", "fine", "link.errors=warning", "burst_rate_hz=0.7"),
    fault("unplugged", "wiring", "link.steady=fault", "unplug_at_s=0.5,unplug_for_s=0.5"),
    fault("freezes", "wiring", "link.steady=fault", "freeze_at_s=0.5,freeze_for_s=0.5"),
    fault("falls silent", "wiring", "link.steady=fault", "silence_at_s=0.5,silence_for_s=0.5"),
    fault("brown-out", "wiring", "link.steady=fault", "brown_out_at_s=0.5"),
    Case("drops frames", "wiring", "link.overflow=fault", scenario="[plate]\ndrop_rate = 0.01\n"),
    fault("narrow link", "wiring", "link.overflow=fault", "slow_reader_bytes_per_s=120000"),
    fault("clumps of 16 ms", "fine", "link.round_trip=warning", "clump_ms=16"),
    fault("another plate", "sensor", "board.fits=fault", "misbehave=other_plate"),
    fault("no channels", "sensor", "board.fits=fault", "misbehave=channels0"),
    fault("reference off", "sensor", "board.reference=fault", "skew_ppm=3000"),
    Case("pressed", "sensor", "sensor.at_rest=fault", emulator=("--scenario", "held")),
    Case("dead plate", "sensor", "sensor.channels=fault", scenario="[plate]\npilot_level_db = -115.0\n"),
    Case("noisy edges", "sensor", "sensor.noise=fault", scenario="[plate]\njitter_s = 3e-8\n"),
    Case("noisy oscillators", "sensor", "sensor.noise=fault", scenario="[plate]\nwhite_fm = 2e-8\n"),
    Case(
        "pilot of another plate",
        "sensor",
        "sensor.tones=fault",
        moved=("pilot_hz = 10.01e6", "pilot_hz = 10.02e6"),
    ),
    Case("thermal shock", "fine", "sensor.drift=warning", plate="comb16", scenario=SHOCK),
    Case("no broker", "software", "broker.listens=fault", url="mqtt://127.0.0.1:9"),
    Case("unknown broker", "software", "broker.name=fault", url="mqtt://no-such-host.invalid:1883"),
    Case("refused", "software", "broker.accepts=fault", broker="allow_anonymous false"),
    Case("Nagle", "fine", "broker.round_trip=warning", broker="set_tcp_nodelay false\nallow_anonymous true"),
)
HEALTHY = (Case("healthy"), Case("healthy comb", plate="comb16"), Case("healthy, other seed"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--healthy", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    healthy = [HEALTHY[number % len(HEALTHY)] for number in range(options.healthy)]
    wrong = unjudged = 0
    print(f"{'asked':<24}{'expected':<38}{'seen':<12}{'s':>5}  also bad")
    for number, case in enumerate([*healthy, *CASES]):
        if options.only not in case.name:
            continue
        began_s = time.monotonic()
        report = examined(case, options.seconds, number)
        bad = [
            f"{finding['id']}={finding['outcome']}"
            for finding in report["findings"]
            if finding["outcome"] in ("warning", "fault") and not finding["id"].startswith(("clock.", "disk."))
        ]
        good = report["verdict"] == case.verdict and (case.seen in bad if case.seen else not bad)
        busy = not good and too_busy(report, case.seen.partition("=")[0])
        wrong += not good and not busy
        unjudged += busy
        others = ", ".join(name for name in bad if name != case.seen)
        expected = f"{case.verdict} {case.seen}"
        mark = report["verdict"] if good else "busy" if busy else f"{report['verdict']} WRONG"
        print(f"{case.name:<24}{expected:<38}{mark:<12}{time.monotonic() - began_s:5.1f}  {others}", flush=True)
    print(f"{wrong} differ, {unjudged} could not be judged on a busy computer; clock.* and disk.* are left out")
    return 1 if wrong else 0


def too_busy(report: dict[str, Any], finding_id: str) -> bool:
    """Whether the doctor said of a finding that the computer was too busy to tell."""
    return any(
        finding["id"] == finding_id and finding["evidence"].startswith("this computer is busy")
        for finding in report["findings"]
    )


def examined(case: Case, seconds: float, seed: int) -> dict[str, Any]:
    """Set the case up, and return the doctor's report."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        link = f"serial:{folder / 'board'}?baud=4000000"
        if case.board:
            link = stack.enter_context(board(case, folder, seed))
        if case.holder:
            stack.enter_context(holder(folder / "board"))
        url = case.url or stack.enter_context(mosquitto(case, folder))
        config = folder / "board.toml"
        config.write_text(f'name = "hand"\nplate = "{case.plate}"\nlink = "{link}"\n[mqtt]\nurl = "{url}"\n')
        done = subprocess.run(
            [*COMMAND, "doctor", "--config", str(config), "--seconds", str(seconds), "--json"],
            stdout=subprocess.PIPE,
            text=True,
            timeout=120,
            check=False,
            env=os.environ | {"XDG_STATE_HOME": name},
        )
        report: dict[str, Any] = json.loads(done.stdout)
        return report


@contextmanager
def board(case: Case, folder: Path, seed: int) -> Iterator[str]:
    """Run an emulated board; yields its link."""
    plate, options = case.plate, list(case.emulator)
    if case.moved is not None:
        path = folder / "plate.toml"
        path.write_text((PLATES / f"{case.plate}.toml").read_text().replace(*case.moved))
        plate = str(path)
    if case.scenario:
        path = folder / "scenario.toml"
        path.write_text(case.scenario)
        options = ["--scenario", str(path)]
    where = ["--tcp", "127.0.0.1:0"] if case.plate != "quartz16" else ["--pty", str(folder / "board")]
    command = [*COMMAND, "emulate", "--plate", plate, *where, *options, "--seed", str(seed), "--json"]
    with started(command, until='"link"') as said:
        yield f"serial:{folder / 'board'}?baud=4000000" if case.plate == "quartz16" else json.loads(said)["link"]


@contextmanager
def holder(port: Path) -> Iterator[None]:
    text = (
        "import fcntl, os, sys; port = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); "
        "fcntl.flock(port, fcntl.LOCK_EX); print('held', flush=True); input()"
    )
    with started([sys.executable, "-c", text, str(port)]):
        yield


@contextmanager
def mosquitto(case: Case, folder: Path) -> Iterator[str]:
    port = free_port()
    config = folder / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\n{case.broker}\nuser root\nlog_dest stderr\n")
    with started(["/usr/sbin/mosquitto", "-c", str(config)], until="running"):
        yield f"mqtt://127.0.0.1:{port}"


@contextmanager
def started(command: list[str], until: str = "") -> Iterator[str]:
    """Run a process until the block ends; yields its first line, or that with `until` in it."""
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        said = []
        for line in process.stdout or ():
            said.append(line)
            if until in line:
                break
        else:
            raise RuntimeError(f"{command[0]} ended: {said}")
        yield said[-1]
    finally:
        process.kill()
        process.communicate()


if __name__ == "__main__":
    sys.exit(main())
