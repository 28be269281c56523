"""What is to be exported where."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from resonator_daemon.exporting.options import CSV, MCAP, NPZ, PARQUET, ROS2
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


def target(options: argparse.Namespace) -> Target:
    """Return what is to be written; ends the program with the code for usage where options do not go together."""
    output: Path = options.output
    if str(output) == "-":
        options.refuse("--output - would be stdout, and files are written; name one (resonatord replay --to - prints)")
    if options.format is None and output.suffix not in _OF_SUFFIX:
        endings = ", ".join(_OF_SUFFIX)
        options.refuse(f"--output {str(output)!r} ends in none of {endings}; name such a file, or give --format")
    form: str = options.format or _OF_SUFFIX[output.suffix]
    allowed = TOPICS[form]
    topics = allowed if options.topics is None else tuple(dict.fromkeys(options.topics.split(",")))
    if unknown := [topic for topic in topics if topic not in allowed]:
        options.refuse(f"--topics {', '.join(map(repr, unknown))}: {form} takes {', '.join(allowed)}")
    if form in _FILE_PER_TOPIC and len(topics) > 1 and takes_a_stream(output):
        options.refuse(f"--output {output} takes one table of {form}, not {len(topics)}; choose it by --topics")
    return Target(output, form, topics)
