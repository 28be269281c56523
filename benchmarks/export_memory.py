"""What an export takes in memory and time: as many messages as a recording of some minutes has, in each format.

Run as `python benchmarks/export_memory.py --minutes 15 60`; needs the extras export and ros2.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from resonator_daemon.config import Config
from resonator_daemon.exporting.formats import FORMATS, format_class
from resonator_daemon.exporting.output import Output, Recorded
from resonator_daemon.plate import load_plate
from resonator_daemon.publishing.message_examples import EXAMPLES
from resonator_daemon.publishing.payloads import Contacts, Forces
from resonator_daemon.publishing.topics import CONTACTS, FORCES
from resonator_daemon.replay.recorded_pipeline import Moment, Published
from resonator_daemon.session.host_time import HostTime

_STEPS_PER_MINUTE = 60 * 200
_METADATA = {"plate": "quartz16"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=int, nargs="+", default=[15, 60])
    parser.add_argument("--one", nargs=2, metavar=("FORMAT", "MINUTES"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        form, minutes = options.one
        print(json.dumps(measure(form, int(minutes))))
        return
    print("format    minutes  peak RSS MB  seconds  file MB")
    for form in FORMATS:
        for minutes in options.minutes:
            command = [sys.executable, __file__, "--one", form, str(minutes)]
            told = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
            print(
                f"{form:9} {minutes:7} {told['rss_mb']:12.1f} {told['seconds']:8.1f} {told['file_mb']:8.1f}", flush=True
            )


def measure(form: str, minutes: int) -> dict[str, float]:
    """Return what it took, in a process of its own: the peak is that of its whole life."""
    with tempfile.TemporaryDirectory() as folder:
        output = make(form, Path(folder))
        begun_s = time.monotonic()
        for moment in moments(minutes * _STEPS_PER_MINUTE):
            output.add(moment)
        files = output.close()
        return {
            "seconds": time.monotonic() - begun_s,
            "rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "file_mb": sum(files.values()) / 1e6,
        }


def moments(steps: int) -> Iterator[Moment]:
    """Give the messages of one press, anew for each step; a replaying would take most of the time."""
    forces = Forces.model_validate(EXAMPLES["Forces"] | {"board_ticks": 1, "t_ns": 1})
    contacts = Contacts.model_validate(EXAMPLES["Contacts"] | {"board_ticks": 1, "t_ns": 1, "contacts": []})
    for seq in range(steps):
        now = {"seq": seq, "t_ns": 10**18 + 5_000_000 * seq}
        messages = (
            Published(FORCES, forces.model_copy(update=now)),
            Published(CONTACTS, contacts.model_copy(update=now)),
        )
        yield Moment(HostTime(now["t_ns"], 0, 0), messages)


def make(form: str, folder: Path) -> Output:
    """Return a begun output, in a folder."""
    kind = format_class(form)
    config = Config(plate=load_plate("quartz16"), link="tcp://127.0.0.1:1", name="hand")
    output = kind(folder / f"out.{form}", kind.available, Recorded(config, _METADATA))
    output.begin()
    return output


if __name__ == "__main__":
    main()
