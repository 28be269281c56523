"""What kept the computer busy, in one sentence."""

import os
import subprocess
import sys

import psutil

from resonator_daemon.demo.host_load import HostLoad
from resonator_daemon.demo.processes import cpu_s

BUSY = "print('busy', flush=True)\nwhile True: pass"


def test_the_busiest_other_process_is_named() -> None:
    with subprocess.Popen([sys.executable, "-c", BUSY], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        load = HostLoad()
        process = psutil.Process(other.pid)
        until_s = cpu_s(process) + 0.5
        while cpu_s(process) < until_s:
            os.sched_yield()
        load.stop()
        words = load.in_words(1e6, set(psutil.pids()) - {other.pid})  # no time is left for others: it is named even so
        name = process.name()
        other.kill()
    its = [used_s for each, used_s in load.used_s.items() if each.pid == other.pid]
    assert len(its) == 1
    assert its[0] >= 0.4
    assert f" of {psutil.cpu_count()} by these processes" in words
    assert f"by {name} (process {other.pid})" in words
