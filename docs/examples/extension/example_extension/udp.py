"""Carrier of boards that send datagrams: udp://host:port."""

import socket
from dataclasses import dataclass
from typing import Self
from urllib.parse import urlsplit

from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.links.link import FileDescriptorLink, Link, LinkUnavailableError
from resonator_daemon.board.links.target import LinkTarget


@dataclass(frozen=True)
class Carrier(LinkTarget):
    """A board that answers datagrams."""

    scheme = "udp"
    syntax = "udp://host:port"
    is_remote = True

    host: str
    port: int

    def __str__(self) -> str:
        return f"udp://{self.host}:{self.port}"

    @classmethod
    def parse(cls, text: str) -> Self:
        url = urlsplit(text)
        if not url.hostname or url.port is None:
            raise ValueError("must be udp://host:port")
        return cls(url.hostname, url.port)

    def open(self) -> Link:
        connection = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            connection.connect((self.host, self.port))
        except OSError as error:
            connection.close()
            raise LinkUnavailableError(ReasonCode.HOST_UNKNOWN, f"{self} cannot be opened: {error}") from error
        connection.setblocking(False)
        return FileDescriptorLink(connection.fileno(), connection.close)
