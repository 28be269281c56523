"""Recordings of the corpus, played once for all tests, and their moments handed to what writes files."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from resonator_daemon.config import Config
from resonator_daemon.exporting.run import Output
from resonator_daemon.replay.recorded_pipeline import Moment
from resonator_daemon.replay.source import open_playback

CORPUS = Path(__file__).parents[1] / "corpus"
METADATA = {"plate": "quartz16", "source_sha256": "00ff"}


class Played(NamedTuple):
    config: Config
    moments: Sequence[Moment]

    def messages(self, path: str) -> list[Any]:
        return [message for moment in self.moments for topic, message in moment.messages if topic.path == path]


def recording(case: str) -> Path:
    return CORPUS / case / "recording.mcap"


@cache
def played(case: str) -> Played:
    with open_playback(recording(case)) as playback:
        return Played(playback.config, list(playback.moments()))


def write(output: Output, moments: Sequence[Moment]) -> None:
    for moment in moments:
        output.take(moment)
    output.close()
