"""What a power failure at any moment costs: recordings and events of a daemon, and a calibration.

Run it with `make soak`, or `python benchmarks/power_failure.py [--seconds N] [--moments N] [--seed N]`.
A daemon records without a broker, with an emulated quartz16 that is pressed at full rate, and all its changes to the
disk are logged (`disk_trace.c`). For moments around each fsync and others by chance, the disk is restored to what it
may hold then, and opened by the daemon's own readers. Then a calibration is written, up to promises that must
hold. Exit code 1 when a file cannot be read, more than a second is missing, or a promise is broken.

The model is weaker than any common file system. Of a file, each sector that was written since the last fsync began may
be new, old or zero, and the size may be any of those it had. Of a directory, each new, renamed or removed name may be
missing until the directory itself was synchronised. The order of changes is not preserved otherwise.
"""

import argparse
import json
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Final, NamedTuple

from parts import COMMAND, child, emulated_board

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.values import plate_text
from resonator_daemon.board.recording.reader import RecordingUnusableError, open_recording
from resonator_daemon.mqtt.event_file import FILE, EventFile, Span
from resonator_daemon.tools.calibration.plate_file import write_plate_file

LOSS_AT_MOST_S: Final = 1.0
PLATE_TEXT: Final = plate_text(load_plate("quartz16"))
NEW_PLATE_TEXT: Final = plate_text(load_plate("quartz16").model_copy(update={"force_max_newton": 5.0}))
CONFIG: Final = 'name = "left"\nplate = "quartz16"\nlink = "{}"\n[mqtt]\nurl = "mqtt://127.0.0.1:9"\n'
RECORDED: Final = '[recording]\nautostart = true\nfile_max_mb = 1\ndirectory = "{}"\n'
ACKNOWLEDGED: Final = "acknowledged"  # a file of the root directory: lines that a program writes after each guarantee
_SECTOR_BYTES: Final = 512
_PAGE_BYTES: Final = 4096
_LARGE_BYTES: Final = 16 * _PAGE_BYTES

KINDS: Final = ("nothing", "everything", "zeros", "some", "some", "some")  # what survives of unsynchronised changes


class Change(NamedTuple):
    """An entry of the log; `data` is what was written, or a path, or two with a zero byte between them."""

    kind: str
    inode: int
    number: int
    time_ns: int
    data: bytes


def traced(folder: Path, root: Path) -> dict[str, str]:
    """Compile the library; return the variables with which a program logs what it changes below `root`."""
    library = folder / "disk_trace.so"
    source = Path(__file__).with_name("disk_trace.c")
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl", "-lpthread"], check=True)
    return {"LD_PRELOAD": str(library), "DISK_TRACE_ROOT": str(root.resolve()), "DISK_TRACE": str(folder / "trace")}


def changes(log: Path) -> list[Change]:
    """Read the log as far as it is complete; inode numbers that were used again are distinguished."""
    content = log.read_bytes()
    found: list[Change] = []
    files: dict[int, int] = {}
    begin = 0
    while (end := content.find(b"\n", begin)) >= 0:
        kind, inode, number, size, time_ns = content[begin:end].split()
        begin = end + 1 + int(size)
        if begin > len(content):
            break
        if kind in (b"make", b"mkdir"):
            files[int(inode)] = len(found)
        known = files.get(int(inode), -1)
        found.append(Change(kind.decode(), known, int(number), int(time_ns), content[end + 1 : begin]))
    return found


@dataclass
class _File:
    synced: bytearray = field(default_factory=bytearray)
    pending: list[tuple[int, Change]] = field(default_factory=list)


class Disk:
    """Changes in their order, applied one by one.

    Attributes
    ----------
    acknowledged
        Lines that the program has written into `ACKNOWLEDGED` so far.
    """

    def __init__(self, root: Path, log: Iterable[Change] = ()) -> None:
        self._root = str(root.resolve()).encode()
        self._files: dict[int, _File] = {}
        self._synced: dict[bytes, int | None] = {}  # by path; None: a directory
        self._pending: list[tuple[int, dict[bytes, tuple[bool, int | None]]]] = []  # (exists, file) by path
        self._current: dict[bytes, int | None] = {}
        self._begun: dict[int, int] = {}
        self._count = 0
        self._acknowledging: int | None = None
        self.acknowledged: list[str] = []
        for change in log:
            self.apply(change)

    def apply(self, change: Change) -> None:
        """Apply the next change."""
        kind, inode, number, _, data = change
        self._count += 1
        match kind:
            case "make" if data == self._root + b"/" + ACKNOWLEDGED.encode():
                self._acknowledging = inode
            case "make":
                self._files[inode] = _File()
                self._name({data: (True, inode)})
            case "mkdir":
                self._name({data: (True, None)})
            case "remove":
                self._name({data: (False, None)})
            case "rename":
                old, new = data.split(b"\0")
                self._name({old: (False, None), new: (True, self._current[old])})
            case "write" if inode == self._acknowledging:
                self.acknowledged += data.decode().splitlines()
            case "write" | "truncate":
                self._files[inode].pending.append((self._count, change))
            case "begin":
                self._begun[number] = self._count
            case "end":
                self._sync(self._begun.pop(number), inode, data)

    def _name(self, names: dict[bytes, tuple[bool, int | None]]) -> None:
        self._pending.append((self._count, names))
        _apply_names(self._current, names)

    def _sync(self, begun: int, inode: int, path: bytes) -> None:
        if file := self._files.get(inode):
            for number, change in file.pending:
                if number < begun:
                    _apply_content(file.synced, change, None, "everything")
            file.pending = [(number, change) for number, change in file.pending if number >= begun]
            return
        kept = []
        for number, names in self._pending:
            if number < begun and any(name.rpartition(b"/")[0] == path for name in names):
                _apply_names(self._synced, names)
            else:
                kept.append((number, names))
        self._pending = kept

    def after_failure(self, kind: str, random: Random) -> dict[str, bytes | None]:
        """Return what survives, by path below the root; None for directories."""
        names = dict(self._synced)
        for _, changed in self._pending:
            if kind == "everything" or (kind != "nothing" and (kind == "zeros" or random.random() < 0.5)):
                _apply_names(names, changed)
        contents: dict[str, bytes | None] = {}
        for path, inode in sorted(names.items()):
            parents = path[len(self._root) + 1 :].split(b"/")[:-1]
            places = (self._root + b"/" + b"/".join(parents[: depth + 1]) for depth in range(len(parents)))
            if all(names.get(place, 0) is None for place in places):
                contents[path[len(self._root) + 1 :].decode()] = (
                    None if inode is None else self._content(inode, kind, random)
                )
        return contents

    def _content(self, inode: int, kind: str, random: Random) -> bytes:
        file = self._files[inode]
        content = bytearray(file.synced)
        for _, change in file.pending:
            _apply_content(content, change, random, kind)
        return bytes(content)


def _apply_names(names: dict[bytes, int | None], changed: dict[bytes, tuple[bool, int | None]]) -> None:
    for path, (exists, inode) in changed.items():
        if exists:
            names[path] = inode
        else:
            names.pop(path, None)


def _apply_content(content: bytearray, change: Change, random: Random | None, kind: str) -> None:
    if kind == "nothing" or (kind == "some" and random is not None and random.random() < 0.2):
        return
    if change.kind == "truncate":
        del content[change.number :]
        content.extend(bytes(change.number - len(content)))
        return
    end = change.number + len(change.data)
    content.extend(bytes(max(0, end - len(content))))
    if kind == "everything":
        content[change.number : end] = change.data
    elif kind == "some" and random is not None:
        for begin, piece in _pieces(change):
            if random.random() < 0.5:
                content[begin : begin + len(piece)] = piece


def _pieces(change: Change) -> Iterator[tuple[int, bytes]]:
    step = _SECTOR_BYTES if len(change.data) <= _LARGE_BYTES else _PAGE_BYTES
    begin = change.number
    while begin < change.number + len(change.data):
        end = min(begin // step * step + step, change.number + len(change.data))
        yield begin, change.data[begin - change.number : end - change.number]
        begin = end


class Failure(NamedTuple):
    """A power failure: contents of the disk afterwards, and the lines acknowledged before."""

    contents: dict[str, bytes | None]
    acknowledged: tuple[str, ...]
    time_ns: int

    def put(self, folder: Path) -> None:
        """Write the contents into an empty directory."""
        for path, content in self.contents.items():
            if content is None:
                (folder / path).mkdir(parents=True, exist_ok=True)
            else:
                (folder / path).write_bytes(content)


def failures(log: list[Change], root: Path, *, others: int, seed: int) -> Iterator[Failure]:
    """Yield failures around each fsync and at other moments, each with several outcomes; equal ones once.

    Parameters
    ----------
    others
        Number of moments besides those of fsyncs.
    """
    random = Random(seed)
    near = {at + step for at, change in enumerate(log) if change.kind in ("begin", "end") for step in (0, 1)}
    near |= set(random.sample(range(len(log) + 1), min(others, len(log) + 1))) | {len(log)}
    disk = Disk(root)
    seen: set[tuple[object, ...]] = set()
    for at in range(len(log) + 1):
        for kind in KINDS if at in near else ():
            contents = disk.after_failure(kind, random)
            state = (*contents.items(), *disk.acknowledged)
            if state not in seen:
                seen.add(state)
                time_ns = log[min(at, len(log) - 1)].time_ns
                yield Failure(contents, tuple(disk.acknowledged), time_ns)
        if at < len(log):
            disk.apply(log[at])


def fail_with_a_daemon(seconds: float, moments: int, seed: int, folder: Path) -> list[str]:
    """Run a daemon for so many seconds, then check the disk after each power failure; return what was wrong."""
    root = folder / "disk"
    root.mkdir()
    with emulated_board("quartz16", folder, "--seed", str(seed)) as board:
        config = folder / "left.toml"
        config.write_text(CONFIG.format(board.link) + RECORDED.format(root / "recordings"))
        variables = traced(folder, root) | {"XDG_STATE_HOME": str(root / "state")}
        with child(*COMMAND, "run", "--config", str(config), **variables):
            time.sleep(seconds)
    log, utc_ahead_ns = changes(folder / "trace"), time.time_ns() - time.monotonic_ns()
    occurred_ns = _events(next(root.glob(f"state/**/{FILE}")).parent)
    begun_ns = next(change.time_ns for change in log if change.data.endswith(b".mcap"))
    lost_s: dict[str, list[float]] = {"frames": [], "events": []}
    wrong: list[str] = []
    for failure in failures(log, root, others=moments, seed=seed):
        with tempfile.TemporaryDirectory() as place:
            failure.put(Path(place))
            last_ns = max([begun_ns, *_recorded_ns(Path(place), wrong)])
            stored = next((path.parent for path in Path(place).glob(f"state/**/{FILE}")), None)
            present = _events(stored) if stored else {}
        missing = [number for number in occurred_ns if number not in present]
        if any(number > min(missing, default=number) for number in present):
            wrong.append(f"events {missing} are missing before others")
        lost_s["frames"].append(max(0.0, 1e-9 * (failure.time_ns - last_ns)))
        first_ns = min((occurred_ns[number] for number in missing), default=failure.time_ns + utc_ahead_ns)
        lost_s["events"].append(max(0.0, 1e-9 * (failure.time_ns + utc_ahead_ns - first_ns)))
    syncs = sum(change.kind == "end" for change in log)
    print(f"{len(lost_s['frames'])} outcomes in {seconds:g} s, {syncs} fsyncs, {len(occurred_ns)} events")
    for what, each_s in lost_s.items():
        each_s.sort()
        print(f"{what} missing before a failure: median {each_s[len(each_s) // 2]:.2f} s, longest {each_s[-1]:.2f} s")
        wrong += [f"{each_s[-1]:.2f} s of {what} are missing"] * (each_s[-1] > LOSS_AT_MOST_S)
    return wrong


def _events(directory: Path) -> dict[int, int]:
    """Return the times of the waiting events, by number."""
    file = EventFile(directory, "")
    try:
        found = [json.loads(event.payload) for event in file.read(Span(0, 2**60, -1), 1_000_000)]
    finally:
        file.close()
    return {event["seq"]: int(event["t_ns"]) for event in found}


def _recorded_ns(disk: Path, wrong: list[str]) -> Iterator[int]:
    """Yield the times of events in recordings."""
    for path in sorted(disk.glob("recordings/*")):
        try:
            with open_recording(str(path)) as recording:
                times_ns = [event.now.monotonic_ns for event in recording.events()]
        except RecordingUnusableError:
            continue  # a file of the last second
        if times_ns != sorted(times_ns):
            wrong.append(f"{path.name}: events are out of order")
        yield from times_ns


# A calibration, written by a process of its own.


def write_calibration(root: Path) -> None:
    plate = root / "own.toml"
    for text in (PLATE_TEXT, NEW_PLATE_TEXT):
        write_plate_file(text, plate)
        _promise(root, "written")


def read_calibration(disk: Path, promised: tuple[str, ...]) -> bool:
    plate = disk / "own.toml"
    versions = [None, PLATE_TEXT, NEW_PLATE_TEXT]
    return (plate.read_text() if plate.exists() else None) in versions[len(promised) : len(promised) + 2]


def _promise(root: Path, text: str) -> None:
    with (root / ACKNOWLEDGED).open("a") as file:
        file.write(f"{text}\n")


def fail_while_calibrating(moments: int, seed: int, folder: Path) -> list[str]:
    """Run a program that calibrates, and read after each power failure what is left; return what was wrong."""
    root = folder / "disk"
    root.mkdir()
    command = [sys.executable, __file__, "--write", str(root)]
    subprocess.run(command, env=os.environ | traced(folder, root), check=True, timeout=60, stdout=subprocess.DEVNULL)
    log, wrong, count = changes(folder / "trace"), list[str](), 0
    present = {str(path.relative_to(root)): path.read_bytes() if path.is_file() else None for path in root.rglob("*")}
    del present[ACKNOWLEDGED]
    if Disk(root, log).after_failure("everything", Random(0)) != present:
        wrong.append("the log of the disk lacks changes")
    for count, failure in enumerate(failures(log, root, others=moments, seed=seed), 1):
        with tempfile.TemporaryDirectory() as place:
            failure.put(Path(place))
            if not read_calibration(Path(place), failure.acknowledged):
                wrong.append(f"outcome {count}, after {failure.acknowledged[-1:]}")
    print(f"{count} outcomes while a calibration is written, {len(wrong)} with a broken promise")
    return wrong


def main() -> int:
    if sys.argv[1:2] == ["--write"]:
        write_calibration(Path(sys.argv[2]))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="of the daemon; 0: calibration alone (default: 30)")
    parser.add_argument("--moments", type=int, default=200, help="besides those of each fsync (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.disable(logging.ERROR)  # the readers report what they find
    wrong = []
    if options.seconds:
        with tempfile.TemporaryDirectory() as folder:
            wrong += fail_with_a_daemon(options.seconds, options.moments, options.seed, Path(folder))
    with tempfile.TemporaryDirectory() as folder:
        wrong += fail_while_calibrating(options.moments, options.seed, Path(folder))
    print("\n".join(wrong) or "nothing wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
