"""Possible contents of a disk after a power failure, from a log of all changes by a program (`disk_trace.c`).

The model is weaker than any common file system. Of a file, each sector that was written since the last fsync began may
be new, old or zero, and the size may be any of those it had. Of a directory, each new, renamed or removed name may be
missing until the directory itself was synchronised. The order of changes is not preserved otherwise.
"""

import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Final, NamedTuple

ACKNOWLEDGED: Final = "acknowledged"  # a file of the root directory: lines that a program writes after each guarantee
_SECTOR_BYTES: Final = 512
_PAGE_BYTES: Final = 4096
_LARGE_BYTES: Final = 16 * _PAGE_BYTES

KINDS: Final = (
    "nothing",
    "everything",
    "zeros",
    "some",
    "some",
    "some",
)  # of the unsynchronised changes, what survives


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
