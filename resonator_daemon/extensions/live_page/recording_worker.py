"""Process that decodes a recording: payloads into a file, and where each is to the standard output.

Each line there is JSON: an object with what the scan found; for each message its topic, time since the beginning in ns,
offset and length; the time up to which all is decoded; at the end an object with what is wrong.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any, BinaryIO, Final, TextIO

from resonator_daemon.base.errors import UserError
from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.recording.reader import Mark, damage_in_words, open_recording
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.tools.replay.recorded_pipeline import open_replay

STREAM_PERIOD_NS: Final = 15_000_000  # a display shows no more
FILE_BYTES_MAX: Final = 2 << 30


def scan(path: Path) -> dict[str, Any]:
    """Return duration and marks of a recording, and what is wrong with the file."""
    begun_ns = last_ns = None
    marks = []
    with open_recording(str(path)) as recording:
        for entry in recording.entries():
            last_ns = entry.now.monotonic_ns
            begun_ns = last_ns if begun_ns is None else begun_ns
            if isinstance(entry, Mark):
                marks.append({"t_s": (last_ns - begun_ns) * 1e-9, "label": entry.text})
        damage = recording.damage
    duration_s = 0.0 if begun_ns is None or last_ns is None else (last_ns - begun_ns) * 1e-9
    return {"duration_s": duration_s, "marks": marks, "truncated": damage and damage_in_words(damage, "shown")}


def decode(path: Path, payloads: BinaryIO, entries: TextIO, bytes_max: int = FILE_BYTES_MAX) -> None:
    """Write the payloads of a recording's messages to one file and their entries to the other, after its scan."""
    found = scan(path)
    offset, begun_ns, ends_early = 0, None, False
    newest_ns: dict[str, int] = {}
    with open_replay(path) as replaying:
        _report(entries, found | {"plate": replaying.config.name or replaying.config.plate.name})
        for moment in replaying.moments():
            now_ns = moment.now.monotonic_ns
            begun_ns = now_ns if begun_ns is None else begun_ns
            t_ns = now_ns - begun_ns
            for topic, message in moment.messages:
                if topic.qos == 0:
                    if t_ns - newest_ns.get(topic.path, -STREAM_PERIOD_NS) < STREAM_PERIOD_NS:
                        continue
                    newest_ns[topic.path] = t_ns
                payload = encode(message)
                payloads.write(payload)
                entries.write(f'["{topic.path}", {t_ns}, {offset}, {len(payload)}]\n')
                offset += len(payload)
            payloads.flush()
            _report(entries, [t_ns])
            if offset > bytes_max:
                ends_early = True
                break
        damage = replaying.damage
    wrong = damage and damage_in_words(damage, "shown")
    if ends_early:
        wrong = f"longer than the {bytes_max >> 20} MB that the page keeps; all before that is shown"
    _report(entries, {"truncated": wrong})


def _report(entries: TextIO, content: object) -> None:
    entries.write(json.dumps(content) + "\n")
    entries.flush()


if __name__ == "__main__":  # RECORDING and the descriptor of the file for the payloads
    os.nice(5)
    with open(int(sys.argv[2]), "wb") as payloads:
        recording = Path(sys.argv[1])
        try:
            decode(recording, payloads, sys.stdout)
        except (LinkUnavailableError, UserError) as error:  # the directory is not for browsers
            failure = str(error).replace(str(recording), recording.name)
            _report(sys.stdout, {"failure": failure})
