"""Ctrl-C exits with 0 from commands that run until stopped alone; every other one prints that it was interrupted."""

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final, NoReturn

import pytest
from brokers import Mosquitto
from observer import observe

from resonator_daemon.commands import main

CORPUS: Final = Path(__file__).parents[1] / "corpus"
COMMAND: Final = (sys.executable, "-m", "resonator_daemon")


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a command leaves, as `board`, is left in a directory of the test's own."""
    monkeypatch.chdir(tmp_path)


def interrupt(*_: object, **__: object) -> NoReturn:
    signal.raise_signal(signal.SIGINT)
    raise AssertionError


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        (("ports",), "links.carriers.serial.serial_ports"),
        (("schema",), "publishing.asyncapi.document"),
        (("status",), "monitoring.status_client.ask_all"),
        (("tare", "--config", "hand.toml"), "config.load_client"),
        (("identify", "tcp://127.0.0.1:9"), "links.carriers.tcp.TcpTarget.open"),
        (("calibrate", "skin", "--config", "hand.toml"), "calibration.skin.load_config"),
        (("config", "explain"), "config.help.explained"),
    ],
)
def test_a_verb_with_an_end_of_its_own_fails(
    arguments: tuple[str, ...], where: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(f"resonator_daemon.{where}", interrupt)
    assert main([*arguments, "--json"]) == 1
    printed = capsys.readouterr()
    assert printed.err == "resonatord: interrupted\n"
    (line,) = printed.out.splitlines()
    failed = json.loads(line)
    assert f"{' '.join(arguments)} ".startswith(f"{failed.pop('verb')} ")
    assert failed == {"ok": False, "error": {"code": "interrupted", "message": "interrupted", "hint": ""}}
    assert main(arguments) == 1
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        (("watch",), "resonator_daemon.view.watch.broker_at"),
        (("run", "--config", "hand.toml"), "resonator_daemon.daemon.config_store.ConfigStore.__init__"),
        (("decode", "--config", "hand.toml"), "resonator_daemon.config.decoder.load_decoder_config"),
        (("emulate", "--plate", "quartz16", "--pty", "board"), "simulators.emulator.run"),
        (("status", "--watch", "--json"), "resonator_daemon.monitoring.status_client.ask_all"),
    ],
)
def test_one_that_runs_until_it_is_stopped_ends_well(
    arguments: tuple[str, ...], where: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(where, interrupt)
    assert main(arguments) == 0
    assert capsys.readouterr() == ("", "")


async def test_a_replay_to_a_broker_states_what_it_published(mosquitto: Mosquitto) -> None:
    recording = str(CORPUS / "touches" / "recording.mcap")
    command = [*COMMAND, "replay", recording, "--url", mosquitto.url, "--name", "hand", "--speed", "0.1", "--json"]
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


INTERRUPTED_IMPORT: Final = """
import builtins, contextlib, signal, sys

def interrupted(name, *rest):
    if name == module:
        with contextlib.suppress(KeyboardInterrupt):  # as inside some libraries
            signal.raise_signal(int(number))
    return import_module(name, *rest)

module, number = sys.argv[1:3]
del sys.argv[1:3]
import_module, builtins.__import__ = builtins.__import__, interrupted
from resonator_daemon.commands import main
sys.exit(main())
"""


@pytest.mark.parametrize("stop", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize(
    ("arguments", "module", "code"),
    [
        (("run", "--config", "hand.toml"), "pydantic", 0),
        (("schema",), "pydantic", 1),
        (("schema", "--help"), "argparse", 1),
        (("run", "--config", "hand.toml"), "argparse", 0),
        (("emulate", "--plate", "quartz16", "--pty", "board"), "numpy", 0),
    ],
)
def test_a_signal_while_modules_load_is_not_lost_in_them(
    arguments: tuple[str, ...], module: str, code: int, stop: signal.Signals
) -> None:
    command = (sys.executable, "-c", INTERRUPTED_IMPORT, module, str(int(stop)), *arguments)
    ended = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (code, "resonatord: interrupted\n" * code)
