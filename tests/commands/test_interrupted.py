"""Ctrl-C exits with 0 from commands that run until stopped alone; every other one prints that it was interrupted."""

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from brokers import Mosquitto
from command_line import PROGRAM
from observer import observe, until

CORPUS: Final = Path(__file__).parents[1] / "corpus"


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a command leaves, as `board`, is left in a directory of the test's own."""
    monkeypatch.chdir(tmp_path)


async def test_a_replay_to_a_broker_states_what_it_published(mosquitto: Mosquitto) -> None:
    recording = str(CORPUS / "touches" / "recording.mcap")
    command = [*PROGRAM, "replay", recording, "--url", mosquitto.url, "--name", "hand", "--speed", "0.1", "--json"]
    async with observe(mosquitto.url) as heard:
        replay = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        await heard.until_count("resonator/hand/forces", 1)
        replay.send_signal(signal.SIGINT)
        await heard.until_last("resonator/hand/state/daemon", state="offline", reason="replaying recording.mcap: over")
    stdout, stderr = replay.communicate(timeout=30)
    assert replay.returncode == 1
    (line,) = stdout.splitlines()
    reported = json.loads(line)
    assert (reported["verb"], reported["ok"], reported["error"]["code"]) == ("replay", False, "interrupted")
    count = sum(reported["messages"].values())
    assert reported["messages"]["forces"] >= 1
    assert stderr.startswith(f"resonatord: interrupted: {count} messages were played out, ")


INTERRUPTED: Final = """
import contextlib, os, signal, sys

class End:
    def __del__(self, kill=os.kill, process=os.getpid(), number=int(sys.argv[2])):
        kill(process, number)

class Finder:
    def find_spec(self, name, *_):
        if name == module:
            with contextlib.suppress(KeyboardInterrupt):  # as inside some libraries
                signal.raise_signal(int(number))

module, number = sys.argv[1:3]
del sys.argv[1:3]
sys.meta_path.insert(0, Finder())
if module == "end":
    sys.end = End()  # deleted last
from resonator_daemon.commands import main
sys.exit(main())
"""


LOST: Final = """
0 pydantic run --config hand.toml
0 numpy emulate --plate quartz16 --pty board
1 argparse schema --help
1 pydantic config explain --json
1 resonator_daemon.board.session.probe identify tcp://127.0.0.1:9 --json
1 resonator_daemon.tools.replay.run replay CORPUS/touches/recording.mcap --to out.jsonl --json
0 end config example
"""  # exit code, module that loads, command


@pytest.mark.parametrize("stop", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("line", LOST.strip().splitlines())
def test_no_signal_is_lost(line: str, stop: signal.Signals) -> None:
    code, module, command = line.replace("CORPUS", str(CORPUS)).split(maxsplit=2)
    python = (sys.executable, "-c", INTERRUPTED, module, str(int(stop)), *command.split())
    ended = subprocess.run(python, capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (int(code), "resonatord: interrupted\n" * int(code))
    if code == "1" and "--json" in command:
        failed = json.loads(ended.stdout)
        assert f"{command} ".startswith(f"{failed.pop('verb')} ")
        assert failed == {"ok": False, "error": {"code": "interrupted", "message": "interrupted", "hint": ""}}


@pytest.mark.parametrize(("stop", "library"), [(signal.SIGTERM, ""), (signal.SIGINT, "pydantic_core")])
@pytest.mark.parametrize("command", ["run hand.toml", "watch", "check hand.toml", "replay run.mcap --to x", "demo"])
async def test_a_process_ends_with_its_code_at_any_time(command: str, stop: signal.Signals, library: str) -> None:
    """At its first line, when it has a handler, and when it has loaded a library."""
    code = int(command.split()[0] not in ("run", "watch"))
    with subprocess.Popen([*PROGRAM, *command.split()], stderr=subprocess.PIPE, text=True) as process:
        proc = Path(f"/proc/{process.pid}")
        await until(lambda: handles_sigterm(proc) and library in (proc / "maps").read_text())
        process.send_signal(stop)
        _, stderr = process.communicate(timeout=30)
    assert (process.returncode, stderr) == (code, "resonatord: interrupted\n" * code)


def handles_sigterm(proc: Path) -> bool:
    caught = (proc / "status").read_text().partition("SigCgt:")[2].split()[0]
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)
