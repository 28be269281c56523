"""What the process that decodes a recording writes about each message, for the server to read."""

import struct
from typing import Final

from resonator_daemon.mqtt.topics import TOPICS

PATHS: Final = tuple(TOPICS)
ENTRY: Final = struct.Struct("<Bqqi")  # index of the path, time since the beginning in ns, offset and length
SCANNED, DONE, FAILED, TIME = 255, 254, 253, 252  # instead of a path; all but TIME are followed by JSON of this length
