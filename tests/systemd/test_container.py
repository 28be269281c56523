"""The units under a real systemd, in their sandbox, with a pseudo-terminal as the board; one boot for all of it."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from container import run_in_container

HERE = Path(__file__).parent
LEFT = (HERE / "left.toml").read_text()
CREDENTIAL = "[Service]\nLoadCredential=mqtt-password:/etc/resonatord/broker.password\n"
QUICK = f"{CREDENTIAL}WatchdogSec=3\nRestartSec=100ms\n"
FILES = {
    "/etc/resonatord/left.toml": LEFT,
    "/etc/resonatord/skin.toml": (HERE / "skin.toml").read_text(),
    "/etc/resonatord/bad.toml": LEFT.replace("quartz16", "quarz16"),
    "/etc/resonatord/broker.password": "secret\n",
    "/etc/systemd/system/resonatord@left.service.d/quick.conf": QUICK,
    "/etc/systemd/system/resonatord-decode@skin.service.d/credential.conf": CREDENTIAL,
    "/etc/mosquitto.conf": "listener 1883 127.0.0.1\npassword_file /etc/mosquitto.password\nuser root\n",
}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return run_in_container(tmp_path_factory.mktemp("container"), (HERE / "in_container.sh").read_text(), FILES)


def shown(text: str) -> dict[str, str]:
    return dict(line.split("=", 1) for line in text.splitlines())


def lines(found: dict[str, str], unit: str) -> list[dict[str, Any]]:
    """The journal's entries of a unit's process."""
    entries = [json.loads(line) for line in found["journal"].splitlines()]
    return [entry for entry in entries if entry.get("_SYSTEMD_UNIT") == f"{unit}.service"]


def test_a_board_on_a_pseudo_terminal_is_measured_and_published(found: dict[str, str]) -> None:
    started, status = shown(found["started"]), json.loads(found["status"])["daemons"][0]
    assert (started["ActiveState"], started["NRestarts"]) == ("active", "0")
    assert re.fullmatch(r"left: \d+ frames/s, \d+ lost", started["StatusText"])
    assert status["pid"] == int(started["MainPID"])
    assert status["link"]["state"] == "online"
    assert status["broker"]["connected"]  # which asks for the password that systemd passed


def test_it_is_nobody(found: dict[str, str]) -> None:
    process = dict(line.split(":\t", 1) for line in found["process"].splitlines() if ":\t" in line)
    assert "0" not in process["Uid"].split() + process["Gid"].split() + process["Groups"].split()
    assert {process[name] for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")} == {"0" * 16}
    assert (process["NoNewPrivs"], process["Seccomp"]) == ("1", "2")


def test_its_directories_are_its_own(found: dict[str, str]) -> None:
    assert found["directories"].splitlines() == [
        "resonatord 750 /var/lib/resonatord",
        "resonatord 750 /var/cache/resonatord",
        "resonatord 755 /run/resonatord/left",
        "root 750 /etc/resonatord",
    ]


def test_a_reload_and_a_wait_for_the_board_are_no_restarts_and_a_stop_no_failure(found: dict[str, str]) -> None:
    started = shown(found["started"])
    for moment in ("reloaded", "waiting"):
        assert shown(found[moment])["MainPID"] == started["MainPID"]
        assert shown(found[moment])["ActiveState"] == "active"
    assert shown(found["stopped"])["Result"] == "success"


def test_one_that_hangs_is_restarted_by_the_watchdog(found: dict[str, str]) -> None:
    started, restarted = shown(found["started"]), shown(found["restarted"])
    assert (restarted["ActiveState"], restarted["NRestarts"]) == ("active", "1")
    assert restarted["MainPID"] != started["MainPID"]
    assert "Failed with result 'watchdog'" in found["journal"]


def test_a_bad_configuration_is_not_tried_again(found: dict[str, str]) -> None:
    bad = shown(found["bad"])
    assert (bad["ActiveState"], bad["ExecMainStatus"], bad["NRestarts"]) == ("failed", "78", "0")
    (line,) = [entry for entry in lines(found, "resonatord@bad") if "quarz16" in entry["MESSAGE"]]
    assert line["PRIORITY"] == "3"


def test_a_decoder_waits_for_its_plate(found: dict[str, str]) -> None:
    decoder = shown(found["decoder"])
    assert (decoder["ActiveState"], decoder["NRestarts"]) == ("active", "0")
    assert decoder["StatusText"]


def test_the_journal_has_the_fields(found: dict[str, str]) -> None:
    (first, *_) = [entry for entry in lines(found, "resonatord@left") if entry["MESSAGE"].startswith("link online")]
    assert first["RESONATORD_NAME"] == "left"
    assert first["PRIORITY"] == "6"
    assert first["SYSLOG_IDENTIFIER"] == "resonatord"
