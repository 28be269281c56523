"""Recordings as tables."""

import os
import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from resonator_daemon.base.errors import UsageError
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.toml import nearest
from resonator_daemon.board.config import Config, load_config
from resonator_daemon.board.recording.reader import SHORTENED_URL
from resonator_daemon.board.recording.remote import local_file, without_secrets
from resonator_daemon.tools.export.output import Recorded
from resonator_daemon.tools.export.run import differences_in_words, file_metadata, moments_within
from resonator_daemon.tools.export.table_formats import MemoryOutput
from resonator_daemon.tools.export.tables import WITH_ARRAYS, WITH_TABLE
from resonator_daemon.tools.python_api import RecordingError, RecordingWarning, readable_errors
from resonator_daemon.tools.python_api.tables import Table
from resonator_daemon.tools.replay.recorded_pipeline import open_replay
from resonator_daemon.tools.replay.span import find_span

DEFAULT_TOPICS: Final = tuple(topic for topic in WITH_TABLE if topic not in WITH_ARRAYS)


class Mark(NamedTuple):
    """A text that somebody wrote into the recording, and when: UTC in ns."""

    t_ns: int
    text: str


@dataclass(frozen=True, eq=False, repr=False)
class LoadedRecording(Mapping[str, Table]):
    """Tables of a recording by topic, as `recording["contacts/event"]`.

    Attributes
    ----------
    path : Path or str
        The file, or its URL without user information, query and fragment.
    name : str
        Name that the plate was published under.
    plate : Plate
        Plate file in use: `plate.site_ids`, `plate.site_positions_m` (n, 2) and more.
    marks : tuple of Mark
        In order.
    problems : tuple of str
        What is wrong with the recording, a sentence each; empty where all of it was loaded.
    """

    path: Path | str
    name: str
    plate: Plate
    marks: tuple[Mark, ...]
    problems: tuple[str, ...]
    _tables: Mapping[str, Table]

    @property
    def forces(self) -> Table:
        """Force, noise and systematic error of each site, one row for each window."""
        return self["forces"]

    @property
    def contacts(self) -> Table:
        """Each touch over time: one row for each contact of each message."""
        return self["contacts"]

    @property
    def contact_events(self) -> Table:
        """Onset, release and slip, one row for each event."""
        return self["contacts/event"]

    @property
    def signals(self) -> Table:
        """Signals of the sites under a skin, one row for each frame."""
        return self["signals"]

    @property
    def decoded(self) -> Table:
        """Maps of traction and displacement of a skin, one row for each frame."""
        return self["decoded"]

    def __getitem__(self, topic: str) -> Table:
        if topic in self._tables:
            return self._tables[topic]
        with readable_errors():
            _check_topics([topic])
            raise RecordingError(
                f"{self.path}: no table of {topic!r} was loaded, but {', '.join(self)}; if the plate has it: "
                f"load_recording(..., topics=[{topic!r}])"
            )

    def __iter__(self) -> Iterator[str]:
        return iter(self._tables)

    def __len__(self) -> int:
        return len(self._tables)

    def __contains__(self, topic: object) -> bool:
        return topic in self._tables

    def __repr__(self) -> str:
        rows = ", ".join(f"{topic} {table.row_count}" for topic, table in self.items())
        return f"<LoadedRecording {str(self.path)!r} of {self.name!r} ({self.plate.name}); rows: {rows}>"


def load_recording(
    path: str | os.PathLike[str],
    *,
    topics: Collection[str] | None = None,
    start: float | str | None = None,
    until: float | str | None = None,
    config: str | os.PathLike[str] | None = None,
) -> LoadedRecording:
    """Load a recording as tables of what was measured: the values that the daemon publishes, in SI units.

    The recorded bytes are measured again, without a broker and faster than they came. Each table has a NumPy array
    for each column; names end in the unit. Every force has two errors, each one standard deviation: `noise_newton`
    averages out, `systematic_newton` does not.

    >>> recording = resonatord.load_recording("run.mcap")
    >>> recording
    <LoadedRecording 'run.mcap' of 'left-index' (quartz16); rows: forces 3988, contacts 3988, contacts/event 12, ...>
    >>> recording.forces["site_7_force_newton"]          # NaN while nothing presses
    array([nan, nan, ..., 1.234, 1.231])
    >>> recording.forces.columns["site_7_force_newton"].unit
    'N'
    >>> recording.contacts.to_pandas()                   # index: UTC

    Parameters
    ----------
    path
        File that `resonatord record` or a daemon wrote, or its URL, as "s3://bucket/run.mcap": fsspec makes a temporary
        copy of the file at a URL.
    topics
        Those to load, as `["forces", "contacts/event"]`; None: all but `signals` and `decoded`. These two have
        arrays, which take up to 6 MB for each second of a skin with 1024 sites.
    start, until
        Seconds from the beginning, or the text of a mark; None: all.
    config
        Configuration file to measure with, in place of the plate and settings that the recording carries.

    Returns
    -------
    LoadedRecording
        Tables by topic; `forces`, `contacts` and `contact_events` are attributes, too.

    Raises
    ------
    RecordingError
        There is no such file, it is no recording, or the server of the URL refuses it.
    UserError
        An argument cannot be used, or the plate and settings in the recording.

    Warns
    -----
    RecordingWarning
        The file is cut off or damaged: what comes before that is loaded. Also where the tables differ from what was
        measured live. `problems` has the sentences.
    """
    wanted = DEFAULT_TOPICS if topics is None else tuple(dict.fromkeys([topics] if isinstance(topics, str) else topics))
    with readable_errors():
        _check_topics(wanted)
        loaded = _load(os.fspath(path), wanted, start, until, load_config(Path(config)) if config else None)
    for problem in loaded.problems:
        warnings.warn(f"{loaded.path}: {problem}", RecordingWarning, stacklevel=2)
    return loaded


def _load(
    path: str, topics: tuple[str, ...], start: float | str | None, until: float | str | None, config: Config | None
) -> LoadedRecording:
    source = without_secrets(path) if "://" in path else Path(path)
    if isinstance(source, Path) and not source.exists() and not SHORTENED_URL.match(path):
        raise RecordingError(f"recording {path}: there is no file {source.absolute()}; `resonatord record` makes one")
    with local_file(path) as file:
        span = find_span(file, *(None if place is None else str(place) for place in (start, until)))
        with open_replay(file, config) as replaying:
            recorded = Recorded(replaying.config, file_metadata(file, replaying.config))
            output = MemoryOutput(topics, recorded)
            output.begin()
            marks = []
            for moment in moments_within(replaying, span):
                output.add(moment)
                if moment.mark is not None:
                    marks.append(Mark(moment.now.utc_ns, moment.mark))
            output.finish()
            problems = differences_in_words(replaying, "loaded")
    tables = {
        topic: Table(topic, output.tables[topic].columns, output.tables[topic].arrays(), recorded.metadata)
        for topic in topics
        if topic in output.tables
    }
    return LoadedRecording(source, recorded.name, recorded.plate, tuple(marks), tuple(problems), tables)


def _check_topics(topics: Collection[str]) -> None:
    for topic in topics:
        if topic not in WITH_TABLE:
            raise UsageError(f"topic {topic!r}: no table has this name; {nearest(topic, WITH_TABLE)}")
