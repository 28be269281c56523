"""Two recordings side by side: touches, forces, losses and timing, as a table and as JSON."""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from difflib import SequenceMatcher
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from rich.table import Table

from resonator_daemon.mqtt.codec import decoded
from resonator_daemon.mqtt.payloads import ContactEvent, Contacts
from resonator_daemon.mqtt.topics import CONTACT_EVENT, CONTACTS
from resonator_daemon.tools.replay.recorded_pipeline import RecordingReplay, open_replay
from resonator_daemon.tools.view.words import number_table


class Touch(NamedTuple):
    """A contact from its onset, in seconds of its recording, to its release; NaN for what is not known."""

    site: int
    onset_s: float
    duration_s: float
    peak_newton: float


@dataclass
class Played:
    """A recording as it was played.

    Attributes
    ----------
    touches
        In the order of their onsets.
    """

    path: Path
    seconds: float = 0.0
    frames: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    connections: int = 0
    damage: str | None = None
    problems: list[str] = field(default_factory=list)
    t_uncertainty_ns: float = math.nan  # median
    unknown: float = math.nan  # share of the messages in which a force is not known
    touches: list[Touch] = field(default_factory=list)

    @property
    def frame_rate_hz(self) -> float:
        return self.frames / self.seconds if self.seconds else math.nan

    def as_json(self) -> dict[str, Any]:
        """Return all but the touches; null for what is not known."""
        keys = ("seconds", "frames", "frame_rate_hz", "lost", "connections", "t_uncertainty_ns", "unknown", "damage")
        return {"file": str(self.path), **{key: _known(getattr(self, key)) for key in keys}}


def play(path: Path) -> Played:
    """Play a recording with the plate and settings that it carries.

    Raises
    ------
    LinkUnavailableError
        The file is no recording.
    ConfigurationError
        What it carries cannot be used.
    """
    result = Played(path)
    with open_replay(path) as replaying:
        _collect(result, replaying)
        counters = replaying.counters
        result.frames, result.connections = counters.frames, counters.connections
        result.lost = asdict(counters.lost)
        result.damage = replaying.damage
        result.problems = [f"{path}: {problem}" for problem in replaying.problems("compared")]
    return result


def _collect(result: Played, replaying: RecordingReplay) -> None:
    begun_ns: int | None = None
    uncertainties_ns: list[int] = []
    unknown = 0
    present: dict[int | None, int] = {}  # number of the touch by the id of its contact
    for moment in replaying.moments():
        begun_ns = moment.now.monotonic_ns if begun_ns is None else begun_ns
        result.seconds = (moment.now.monotonic_ns - begun_ns) * 1e-9
        for topic, message in moment.messages:
            payload = decoded(topic.payload, message) if topic in (CONTACTS, CONTACT_EVENT) else None
            if isinstance(payload, Contacts):
                uncertainties_ns.append(payload.t_uncertainty_ns)
                unknown += any(math.isnan(contact.force_newton[2]) for contact in payload.contacts)
            elif isinstance(payload, ContactEvent):
                _add_event(result.touches, present, payload, result.seconds)
    if uncertainties_ns:
        result.t_uncertainty_ns = median(uncertainties_ns)
        result.unknown = unknown / len(uncertainties_ns)


def _add_event(touches: list[Touch], present: dict[int | None, int], event: ContactEvent, now_s: float) -> None:
    """Add a touch at the onset of its contact; complete it at the release."""
    contact = event.contact
    if event.event == "onset":
        present[contact.id] = len(touches)
        touches.append(Touch(contact.site, now_s, math.nan, math.nan))
    elif event.event == "release" and (number := present.pop(contact.id, None)) is not None:
        duration_s, peak_newton = contact.duration_s, contact.peak_newton
        touches[number] = touches[number]._replace(duration_s=duration_s, peak_newton=peak_newton)


@dataclass(frozen=True)
class Comparison:
    """Two recordings, `a` and `b`, with their touches aligned by the order of their sites."""

    a: Played
    b: Played

    @property
    def pairs(self) -> list[tuple[Touch | None, Touch | None]]:
        """Touches of both that correspond to each other; None next to one that the other recording does not have."""
        first, second = self.a.touches, self.b.touches
        sites = ([touch.site for touch in first], [touch.site for touch in second])
        pairs: list[tuple[Touch | None, Touch | None]] = []
        for kind, from_a, to_a, from_b, to_b in SequenceMatcher(None, *sites, autojunk=False).get_opcodes():
            if kind == "equal":
                pairs += zip(first[from_a:to_a], second[from_b:to_b], strict=True)
            else:
                pairs += [(touch, None) for touch in first[from_a:to_a]]
                pairs += [(None, touch) for touch in second[from_b:to_b]]
        return pairs

    def as_json(self) -> dict[str, Any]:
        """Return both recordings, and each pair of touches."""
        touches = [{"a": _touch_json(one), "b": _touch_json(other)} for one, other in self.pairs]
        return {"a": self.a.as_json(), "b": self.b.as_json(), "touches": touches}

    def table(self) -> Table:
        """Return losses, timing and touches of both in columns, and their differences."""
        table = number_table("", "A", "B", "B - A")
        for label, one, other, form in self._rows():
            known = math.isfinite(one) and math.isfinite(other)
            difference = format(other - one, f"+{form}") if known else ""
            table.add_row(label, _number(one, form), _number(other, form), difference)
        return table

    def _rows(self) -> Iterator[tuple[str, float, float, str]]:
        a, b = self.a, self.b
        yield "seconds", a.seconds, b.seconds, ".3f"
        yield "frames", a.frames, b.frames, ".0f"
        yield "frames a second", a.frame_rate_hz, b.frame_rate_hz, ".1f"
        yield "connections", a.connections, b.connections, ".0f"
        for cause in dict.fromkeys((*a.lost, *b.lost)):
            one, other = a.lost.get(cause, 0), b.lost.get(cause, 0)
            if one or other:
                yield f"lost: {cause}", one, other, ".0f"
        yield "uncertainty of times, µs", 1e-3 * a.t_uncertainty_ns, 1e-3 * b.t_uncertainty_ns, ".1f"
        yield "messages with an unknown force, %", 100 * a.unknown, 100 * b.unknown, ".2f"
        yield "touches", len(a.touches), len(b.touches), ".0f"
        for number, (one_touch, other_touch) in enumerate(self.pairs, 1):
            touch_a, touch_b = one_touch or _NONE, other_touch or _NONE
            name = f"touch {number}, site {(one_touch or other_touch or _NONE).site}"
            yield f"{name}: onset, s", touch_a.onset_s, touch_b.onset_s, ".3f"
            yield f"{name}: duration, s", touch_a.duration_s, touch_b.duration_s, ".3f"
            yield f"{name}: peak, N", touch_a.peak_newton, touch_b.peak_newton, ".4f"


_NONE = Touch(0, math.nan, math.nan, math.nan)


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"


def _known(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _touch_json(touch: Touch | None) -> dict[str, object] | None:
    return None if touch is None else {key: _known(value) for key, value in touch._asdict().items()}
