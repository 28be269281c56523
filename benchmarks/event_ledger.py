"""Account of contact events: those made, those received live or by command, and the touches that caused them."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

_DETECTED_NEWTON = 0.02  # the force of an onset, by docs/reference/mqtt-topics.md
_TOLERANCE_NS = 100_000_000  # of an event's time: the window, and the readings that a release takes


class Received(NamedTuple):
    """One message of `contacts/event`."""

    run: str  # daemon_boot_id
    seq: int
    replayed: bool
    content: tuple[str, int | None, int]  # event, site, t_ns


class Touch(NamedTuple):
    """A touch that happened, by the emulator: where, and while its force was enough for an event; UTC in ns."""

    site: int
    start_ns: int
    end_ns: int


def received(message: dict[str, Any]) -> Received:
    """Return an event from a message's JSON object."""
    content = (message["event"], message["contact"]["site"], int(message["t_ns"]))
    return Received(message["daemon_boot_id"], message["seq"], message["replayed"], content)


@dataclass
class Ledger:
    """Events in the order of their arrival; `made` has the number of events by run."""

    live: list[Received] = field(default_factory=list)
    by_command: list[Received] = field(default_factory=list)
    made: dict[str, int] = field(default_factory=dict)

    def newest(self, run: str) -> int:
        """Return the greatest `seq` that was received live; -1 where none was."""
        return max((event.seq for event in self.live if event.run == run), default=-1)

    def numbers(self, *, with_command: bool) -> set[tuple[str, int]]:
        """Return run and `seq` of the events that were received, of those made."""
        events = (*self.live, *self.by_command) if with_command else self.live
        return {(event.run, event.seq) for event in events if event.seq < self.made.get(event.run, 0)}

    def gaps(self, run: str) -> list[int]:
        """Return the numbers of the events of a run that were not received yet, in order."""
        present = self.numbers(with_command=True)
        return [seq for seq in range(self.made[run]) if (run, seq) not in present]

    def not_live(self, run: str) -> list[tuple[int, int]]:
        """Return the first and the last number of each row of events of a run that were not received live."""
        live = self.numbers(with_command=False)
        spans: list[tuple[int, int]] = []
        for seq in (seq for seq in range(self.made.get(run, 0)) if (run, seq) not in live):
            if spans and spans[-1][1] == seq - 1:
                spans[-1] = (spans[-1][0], seq)
            else:
                spans.append((seq, seq))
        return spans

    @property
    def missing(self) -> int:
        return sum(len(self.gaps(run)) for run in self.made)

    @property
    def doubles_unmarked(self) -> int:
        """Live events that came before and are not marked `replayed`."""
        seen: set[tuple[str, int]] = set()
        count = 0
        for event in self.live:
            count += (event.run, event.seq) in seen and not event.replayed
            seen.add((event.run, event.seq))
        return count

    @property
    def out_of_order(self) -> int:
        """Live events that came for the first time, and after a later one of their run."""
        seen: set[tuple[str, int]] = set()
        last: dict[str, int] = {}
        count = 0
        for event in self.live:
            if (event.run, event.seq) not in seen:
                count += event.seq < last.get(event.run, -1)
                last[event.run] = max(last.get(event.run, -1), event.seq)
            seen.add((event.run, event.seq))
        return count

    @property
    def contradictions(self) -> int:
        """Events that came twice with different contents."""
        contents: dict[tuple[str, int], set[object]] = {}
        for event in (*self.live, *self.by_command):
            contents.setdefault((event.run, event.seq), set()).add(event.content)
        return sum(len(several) > 1 for several in contents.values())

    def unreported(self, touches: Iterable[Touch], run: str) -> list[Touch]:
        """Return the touches without an onset and a release of a run at their times."""
        events = [event.content for event in (*self.live, *self.by_command) if event.run == run]
        times: dict[tuple[str, int | None], list[int]] = {}
        for kind, site, t_ns in events:
            times.setdefault((kind, site), []).append(t_ns)

        def near(kind: str, site: int, t_ns: int) -> bool:
            return any(abs(t - t_ns) <= _TOLERANCE_NS for t in times.get((kind, site), ()))

        return [
            touch
            for touch in touches
            if not (near("onset", touch.site, touch.start_ns) and near("release", touch.site, touch.end_ns))
        ]

    def measured_between(self, run: str) -> tuple[int, int]:
        """Return the times of the first and the last event of a run, UTC in ns."""
        times = [event.content[2] for event in (*self.live, *self.by_command) if event.run == run]
        return (min(times), max(times)) if times else (0, 0)


def read_touches(truth: Path) -> list[Touch]:
    """Return the touches of an emulator's truth file, in the order of their ends."""
    return list(_touches(truth))


def _touches(truth: Path) -> Iterator[Touch]:
    present: dict[int, tuple[int, int, int]] = {}  # site, start_ns, end_ns by id
    with truth.open() as lines:
        for line in lines:
            if not line.endswith("\n"):
                return  # of an emulator that was killed while it wrote
            if '"contacts": []' in line and not present:
                continue
            frame = json.loads(line)
            t_ns = int(frame["t_ns"])
            pressed = {c["id"]: c["site"] for c in frame["contacts"] if c["force_newton"][2] >= _DETECTED_NEWTON}
            for identifier, site in pressed.items():
                start_ns = present[identifier][1] if identifier in present else t_ns
                present[identifier] = (site, start_ns, t_ns)
            for identifier in present.keys() - pressed.keys():
                yield Touch(*present.pop(identifier))
