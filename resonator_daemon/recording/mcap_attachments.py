"""Attachments of an MCAP file, checked against the check sum that each has."""

import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from typing import Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Attachment, McapRecord

_TIMES_BYTES: Final = 16
_CRC: Final = struct.Struct("<I")
_UNREADABLE: Final = (McapError, ValueError, OverflowError, MemoryError, struct.error)


@dataclass
class DamagedAttachment(McapRecord):
    """An attachment with a wrong check sum, or one that cannot be read.

    Parameters
    ----------
    name
        As it is in the file, which may be damaged, too; a question mark where it cannot be read.
    """

    name: str


def read_attachment(content: bytes) -> Attachment | DamagedAttachment:
    """Read the content of an attachment's record.

    As in the specification of MCAP the check sum, CRC-32, is of all content before it, and 0 means that there is none.
    """
    with suppress(*_UNREADABLE):
        (crc,) = _CRC.unpack(content[-_CRC.size :])
        if crc in (0, zlib.crc32(content[: -_CRC.size])):
            attachment: Attachment = Attachment.read(ReadDataStream(BytesIO(content)))
            return attachment
    return DamagedAttachment(_name(content))


def _name(content: bytes) -> str:
    name = "?"
    with suppress(*_UNREADABLE):
        name = ReadDataStream(BytesIO(content[_TIMES_BYTES:])).read_prefixed_string()
    return name
