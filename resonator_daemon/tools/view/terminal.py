"""The page of the live view: some plates under each other, in as much detail as the terminal has room for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from rich.columns import Columns
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.rule import Rule
from rich.segment import Segment
from rich.text import Text

from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.mqtt.payloads import Condition, State
from resonator_daemon.mqtt.topics import (
    DECODED,
    DECODED_SUMMARY,
    FORCES,
    HEALTH,
    INFO,
    STATE_DAEMON,
    STATE_LINK,
    STATE_SENSOR,
)
from resonator_daemon.tools.view.maps import side_by_side
from resonator_daemon.tools.view.plate_view import PlateView, Truth
from resonator_daemon.tools.view.touches import SurfacePanel, TouchesPanel
from resonator_daemon.tools.view.words import duration, losses_in_words, quantity

_GAP: Final = 2
_TEXT_COLUMNS_MIN: Final = 30
_BODY_ROWS_MIN: Final = 4
_SILENT_S: Final = 3.0  # a running daemon publishes its health once a second


def render(views: Sequence[PlateView], truths: Mapping[str, Truth], now_utc_ns: int, *, title: str) -> RenderableType:
    """Return a page with every plate, and the truth next to what was measured for those plates that have one."""
    return _Page(title, [_Plate(view, truths.get(view.name), now_utc_ns) for view in views])


def summary_line(view: PlateView, now_utc_ns: int) -> str:
    """Return a plate in one line of text, for where there is no terminal."""
    plate = _Plate(view, None, now_utc_ns)
    return f"{view.name}: {plate.states().plain}; {plate.summary()}"


@dataclass(frozen=True)
class _Page:
    title: str
    plates: Sequence["_Plate"]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(self.title, style="bold", no_wrap=True, overflow="ellipsis")
        heads = [console.render_lines(plate.head(), options.update(height=None)) for plate in self.plates]
        rows_left = (options.height or console.height) - 1 - sum(map(len, heads))
        for plate, head in zip(self.plates, heads, strict=True):
            yield from side_by_side([(options.max_width, head)])
            yield from plate.body(console, options, rows_left // len(heads))


@dataclass(frozen=True)
class _Plate:
    """One plate at one instant."""

    view: PlateView
    truth: Truth | None
    now_utc_ns: int

    def head(self) -> RenderableType:
        info = self.view.last(INFO)
        words = [self.view.name, *([info.plate, info.link] if info else ["plate unknown"])]
        words = list(dict.fromkeys(words))  # a plate may be named after its kind
        return Group(Rule(Text(" · ".join(words), style="bold"), align="left", style="dim"), self.states())

    def states(self) -> Text:
        daemon, link, sensor = (self.view.last(topic) for topic in (STATE_DAEMON, STATE_LINK, STATE_SENSOR))
        offline = daemon is not None and daemon.state is Condition.OFFLINE
        silent = self.view.age_s(self.now_utc_ns) > _SILENT_S
        return Text("   ").join(
            [
                self._state("daemon", daemon, outdated=silent and not offline),
                self._state("link", link, outdated=silent or offline),
                self._state("sensor", sensor, outdated=silent or offline, reported=link.reason if link else ""),
            ]
        )

    def summary(self) -> str:
        return f"{self._panel(colours=False).words()}; {self._losses()}; {', '.join(self._figures())}"

    def body(self, console: Console, options: ConsoleOptions, rows: int) -> RenderResult:
        """Yield the maps and next to them the words, or where there is no room for both a summary."""
        if rows < _BODY_ROWS_MIN:
            yield Text(self.summary(), no_wrap=True, overflow="ellipsis")
            return
        colours = console.color_system in ("256", "truecolor") and not console.no_color
        panel = self._panel(colours=colours)
        maps = [
            (Segment.get_line_length(block[0]) + _GAP, block)
            for block in panel.maps(rows, options.max_width - _TEXT_COLUMNS_MIN)
        ]
        columns = options.max_width - sum(width for width, _ in maps)
        words = Group(*panel.text(), Text(self._losses()), Columns(self._figures(), padding=(0, 2)))
        text = console.render_lines(words, options.update(width=columns, height=None))
        if len(text) > rows:
            text[rows - 1 :] = [[Segment("... more in a larger terminal")]]
        yield from side_by_side([*maps, (columns, text)])

    @property
    def _decodes(self) -> bool:
        has_true_map = self.truth is not None and self.truth.traction_z_pascal is not None
        return has_true_map or self.view.last(DECODED) is not None or self.view.last(DECODED_SUMMARY) is not None

    def _panel(self, *, colours: bool) -> SurfacePanel | TouchesPanel:
        if self._decodes:
            return SurfacePanel(self.view, self.truth, self.now_utc_ns, colours=colours)
        return TouchesPanel(self.view, self.truth, self.now_utc_ns)

    def _state(self, name: str, state: State | None, *, outdated: bool, reported: str = "") -> Text:
        text = Text(f"{name} ")
        if state is None:
            return text.append("unknown", "reverse")
        if outdated:
            return text.append("unknown", "reverse").append(f" (was {state.state})")
        if state.state is Condition.ONLINE and state.reason_code != ReasonCode.COMPUTER_BUSY:
            return text.append("online", "bold")
        text.append(state.state, "reverse")
        if state.since_t_ns is not None:
            text.append(f" for {duration((self.now_utc_ns - state.since_t_ns) / 1e9)}")
        return text if reported and reported in state.reason else text.append(f": {state.reason}")

    def _figures(self) -> list[str]:
        health = self.view.current(HEALTH, self.now_utc_ns)
        results, topic = ("decoded", DECODED) if self._decodes else ("forces", FORCES)
        figures = [
            f"frames {quantity(health.frame_rate_hz if health else None, '.1f', '/s')}",
            f"{results} {quantity(self.view.rate_hz(topic, self.now_utc_ns), '.0f', '/s')}",
        ]
        if self.truth is not None and self.truth.latency_ms is not None:
            median_ms, slow_ms = self.truth.latency_ms
            figures += [f"latency p50 {median_ms:.1f} ms", f"latency p99 {slow_ms:.1f} ms"]
        if health is None:
            figures.append("health unknown")
        else:
            figures.append(f"processor {quantity(health.cpu_percent, '.0f', ' %')}")
            figures.append(f"memory {quantity(health.rss_mb, '.0f', ' MB')}")
            figures.append(f"clock drift {quantity(health.clock_drift_ppm, '+.2f', ' ppm')}")
        return figures

    def _losses(self) -> str:
        if self.view.lost is None:
            return "losses unknown"
        if self.truth is not None:
            counts = dict(self.truth.losses)
        else:
            counts = self.view.lost.model_dump()
            if (health := self.view.current(HEALTH, self.now_utc_ns)) is not None:
                counts |= {"parts": health.parts_lost, "not_decoded": health.frames_not_decoded}
        counts["missed_by_this_view"] = sum(self.view.missed.values())
        return losses_in_words(counts)
