"""Export format of one JSON object per line: `resonatord export run.mcap --output run.jsonl`."""

import json
from typing import Any

from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import FORCES, Topic
from resonator_daemon.tools.export.output import Output


class Format(Output):
    """File of the messages on `forces`, each with its topic."""

    available = (FORCES.path,)

    def begin(self) -> None:
        self._lines = self._new_file()

    def put(self, topic: Topic[Any], message: Message, now_ns: int) -> None:
        line = {"topic": topic.path, "published_ns": now_ns, **message.model_dump(mode="json")}
        self._lines.file.write(json.dumps(line).encode() + b"\n")
        self.rows[topic.path] += 1

    def finish(self) -> None:
        pass
