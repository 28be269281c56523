"""Recordings of the corpus, played once for all tests, and their moments handed to what writes files."""

import base64
import signal
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from resonator_daemon.board.config import Config
from resonator_daemon.mqtt.codec import decoded
from resonator_daemon.tools.export import format_class
from resonator_daemon.tools.export.output import Output, Recorded
from resonator_daemon.tools.replay.recorded_pipeline import Moment, RecordingReplay, open_replay

CORPUS = Path(__file__).parents[1] / "corpus"
METADATA = {"plate": "quartz16", "source_sha256": "00ff"}


class Played(NamedTuple):
    config: Config
    moments: list[Moment]

    def messages(self, path: str) -> list[Any]:
        return [
            decoded(topic.payload, message)
            for moment in self.moments
            for topic, message in moment.messages
            if topic.path == path
        ]


def recording(case: str) -> Path:
    return CORPUS / case / "recording.mcap"


@cache
def played(case: str) -> Played:
    with open_replay(recording(case)) as replaying:
        return Played(replaying.config, list(replaying.moments()))


def interrupt_at(
    number: int, patch: pytest.MonkeyPatch, stop: signal.Signals, when: Callable[[], bool] = lambda: True
) -> None:
    """Raise the signal before this moment of each recording that is replayed, where the condition holds."""
    whole = RecordingReplay.moments

    def interrupted(replaying: RecordingReplay) -> Any:
        for index, moment in enumerate(whole(replaying)):
            if index == number and when():
                signal.raise_signal(stop)
            yield moment

    patch.setattr(RecordingReplay, "moments", interrupted)


def write(form: str, path: Path, case: str, *more: Moment, times: int = 1) -> Output:
    """Write the moments of a case so many times, and more of them, in a format."""
    kind = format_class(form)
    output = kind(path, kind.available, Recorded(played(case).config, METADATA))
    output.begin()
    output.start(recording(case), "", played(case).config)
    for moment in (*times * played(case).moments, *more):
        output.add(moment)
    output.close()
    return output


def cloud_points(data: bytes, fields: list[tuple[str, int, int]], stride: int) -> Any:
    """Points of a cloud as records; of each field name, number of its type (MCAP's or that of ROS), and offset."""
    names, types, offsets = zip(*fields, strict=True)
    forms = [{3: "<u2", 4: "<u2", 7: "<f4", 8: "<f8"}[number] for number in types]
    layout = {"names": names, "formats": forms, "offsets": offsets, "itemsize": stride}
    return np.frombuffer(data, np.dtype(layout))  # type: ignore[call-overload]


def points(drawn: dict[str, Any]) -> Any:
    """Points of a cloud, or cells of a grid, in JSON for Foxglove."""
    fields = [(field["name"], field["type"], field["offset"]) for field in drawn["fields"]]
    return cloud_points(base64.b64decode(drawn["data"]), fields, drawn.get("point_stride") or drawn["cell_stride"])
