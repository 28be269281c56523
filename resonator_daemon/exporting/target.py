"""What is to be exported where."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from resonator_daemon.errors import UsageError
from resonator_daemon.exporting.formats import CSV, MCAP, NPZ, PARQUET, ROS2
from resonator_daemon.exporting.tables import WITH_ARRAYS, WITH_TABLE
from resonator_daemon.host.new_file import takes_a_stream
from resonator_daemon.publishing.topics import INFO

TOPICS: Final[dict[str, tuple[str, ...]]] = {
    CSV: tuple(path for path in WITH_TABLE if path not in WITH_ARRAYS),
    MCAP: (*WITH_TABLE, INFO.path),
    NPZ: WITH_TABLE,
    PARQUET: WITH_TABLE,
    ROS2: WITH_TABLE,
}
"""Paths of the topics that each format takes."""

_OF_SUFFIX: Final = {".csv": CSV, ".mcap": MCAP, ".npz": NPZ, ".parquet": PARQUET}
_FILE_PER_TOPIC: Final = (CSV, PARQUET)


@dataclass(frozen=True)
class Target:
    """What is to be written where.

    Parameters
    ----------
    output
        As it was given.
    form
        One of the formats of `TOPICS`.
    topics
        Paths of those to be exported.
    """

    output: Path
    form: str
    topics: tuple[str, ...]

    def place(self, topic: str) -> Path:
        """Return the file of a topic: the output itself, or one beside it where there are many."""
        if self.form not in _FILE_PER_TOPIC or len(self.topics) == 1:
            return self.output
        return self.output.with_name(f"{self.output.stem}-{topic.replace('/', '-')}{self.output.suffix}")


def make_target(output: Path, form: str | None, topics: str | None) -> Target:
    """Return what is to be written where.

    Parameters
    ----------
    output
        As it was given.
    form
        One of the formats of `TOPICS`; None: by the ending of `output`.
    topics
        Paths of topics with commas between them; None: all that the format has.

    Raises
    ------
    UsageError
        They do not go together.
    """
    if str(output) == "-":
        raise UsageError(
            "--output - would be stdout, and files are written; name one (resonatord replay --to - prints)"
        )
    if form is None and output.suffix not in _OF_SUFFIX:
        endings = ", ".join(_OF_SUFFIX)
        raise UsageError(f"--output {str(output)!r} ends in none of {endings}; name such a file, or give --format")
    form = form or _OF_SUFFIX[output.suffix]
    allowed = TOPICS[form]
    chosen = allowed if topics is None else tuple(dict.fromkeys(topics.split(",")))
    if unknown := [topic for topic in chosen if topic not in allowed]:
        raise UsageError(f"--topics {', '.join(map(repr, unknown))}: {form} takes {', '.join(allowed)}")
    if form in _FILE_PER_TOPIC and len(chosen) > 1 and takes_a_stream(output):
        raise UsageError(f"--output {output} takes one table of {form}, not {len(chosen)}; choose it by --topics")
    return Target(output, form, chosen)
