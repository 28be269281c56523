"""A daemon on a disk that takes nothing, full or read-only: it measures on, says each matter once, and recovers."""

import logging
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from brokers import Mosquitto
from observer import observe
from service_bench import Bench
from small_disk import small_disk

from resonator_daemon.board.recording import recorder as recording
from resonator_daemon.daemon.service.config_store import ConfigStore
from resonator_daemon.daemon.service.daemon import Service
from resonator_daemon.mqtt import event_log

MOUNT = shutil.which("mount") or "/bin/mount"


def remount(disk: Path, how: str) -> None:
    subprocess.run([MOUNT, "-o", f"remount,{how}", str(disk)], check=True)


@pytest.mark.parametrize("how", ["full", "read-only"])
async def test_a_disk_that_takes_nothing(
    tmp_path: Path, mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    caplog.set_level(logging.WARNING)
    monkeypatch.setattr(recording, "TIMES", recording.RecorderTimes(retry_s=0.3))
    monkeypatch.setattr(event_log, "RETRY_S", 0.3)
    bench = Bench(tmp_path, mosquitto.url)
    with small_disk(tmp_path, 1 << 20) as (disk, fill, free):
        monkeypatch.setenv("XDG_STATE_HOME", str(disk))
        config = bench.recording_config("min_free_mb = 0", disk / "recordings")
        spoil: Callable[[], None] = fill if how == "full" else lambda: remount(disk, "ro")
        mend: Callable[[], None] = free if how == "full" else lambda: remount(disk, "rw")
        spoil()
        async with observe(mosquitto.url, "resonator/hand/#") as observer, bench.emulated(scenario="touches"):
            async with bench.running(Service(ConfigStore(config, disk / "last-good"))):
                await observer.until_count("resonator/hand/contacts/event", 2)
                await observer.until_count("resonator/hand/health", 3)
                last = observer.payloads("resonator/hand/health")[-1]
                assert last["recording"]["failure"]
                on_disk = [record for record in caplog.records if "link_state" not in record.name]  # of a busy machine
                said = Counter(record.getMessage() for record in on_disk)
                assert said
                assert max(said.values()) == 1, said
                mend()

                def written() -> bool:
                    return observer.payloads("resonator/hand/health")[-1]["recording"]["failure"] is None

                await observer.until(written)
            events = observer.payloads("resonator/hand/contacts/event")
    assert [event["seq"] for event in events] == list(range(len(events)))
    assert observer.payloads("resonator/hand/health")[-1]["messages"]["dropped"].get("spool_failed", 0) == 0
