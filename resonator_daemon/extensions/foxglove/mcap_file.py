"""A recording as an MCAP file for Foxglove and other viewers: each message as JSON, and what they draw of it."""

import json
from typing import Any

from resonator_daemon.board.config.values import plate_text, settings_text
from resonator_daemon.board.recording.reader import MARKS, PLATE_FILE, SETTINGS_FILE, Mark, encode_mark
from resonator_daemon.extensions.foxglove.messages import ChannelMessage, FoxgloveMessages
from resonator_daemon.extensions.foxglove.schemas import LOG, Schema
from resonator_daemon.extensions.viewer_support import Geometry, McapOutput
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import INFO, TONES, Topic
from resonator_daemon.tools.export.tables import WITH_TABLE
from resonator_daemon.tools.replay.recorded_pipeline import Moment


class Format(McapOutput):
    """The channels of the live bridge, each message at the time when it was published."""

    available = (*WITH_TABLE, INFO.path, TONES.path)
    schema_encoding = "jsonschema"
    message_encoding = "json"

    def begin(self) -> None:
        super().begin()
        config = self._recorded.config
        for name, text in ((PLATE_FILE, plate_text(config.plate)), (SETTINGS_FILE, settings_text(config))):
            self._writer.add_attachment(0, 0, name, "application/toml", text.encode())
        self._messages = FoxgloveMessages(self._recorded.name, Geometry.of_plate(config.plate))
        self._drawn = False

    def add(self, moment: Moment) -> None:
        now_ns = moment.now.utc_ns
        if moment.mark is not None:
            self._put_json(MARKS, LOG, encode_mark(Mark(moment.now, moment.mark)), now_ns, now_ns)
        super().add(moment)

    def put(self, topic: Topic[Any], message: Message, now_ns: int) -> None:
        if not self._drawn:
            self._drawn = True
            for drawing in self._messages.of_plate(now_ns):
                self._put(drawing, now_ns)
        for made in self._messages.of_message(topic.path, message, now_ns):
            self._put(made, now_ns)

    def _put(self, made: ChannelMessage, now_ns: int) -> None:
        self._put_json(made.channel, made.schema, made.encode(), now_ns, made.t_ns)

    def _put_json(self, channel: str, schema: Schema, data: bytes, now_ns: int, t_ns: int) -> None:
        definition = "" if channel in self._channels else json.dumps(schema)
        self.write(channel, schema["title"], definition, data, now_ns, t_ns)
