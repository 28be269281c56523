"""A TCP relay before a broker, which can cut connections, refuse MQTT 5 and limit what goes to the broker."""

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

_PIECE_BYTES = 4096
_KERNEL_BUFFER_BYTES = 16_384  # else the kernel takes megabytes before a sender can notice a limit
_UNSUPPORTED_VERSION = b"\x20\x03\x00\x84\x00"


class Relay:
    """Relay to the broker at a URL; `url` is its own, `bytes_per_s` limits what goes to the broker."""

    def __init__(self, broker_url: str, refuse_mqtt_5: bool) -> None:
        self._port = urlsplit(broker_url).port
        self._refuse_mqtt_5 = refuse_mqtt_5
        self.bytes_per_s: float | None = None
        self._pipes: set[asyncio.Task[None]] = set()
        self._writers: list[asyncio.StreamWriter] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BUFFER_BYTES)  # connections inherit it
        self.port: int = self._listener.getsockname()[1]
        self.url = f"mqtt://127.0.0.1:{self.port}"

    def cut(self) -> None:
        """End all connections without a word to either side."""
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()

    async def start(self) -> asyncio.Server:
        return await asyncio.start_server(self._serve, sock=self._listener, limit=_PIECE_BYTES)

    async def stop(self) -> None:
        for task in tuple(self._pipes):
            task.cancel()
        if self._pipes:
            await asyncio.wait(tuple(self._pipes))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        first = b""
        if self._refuse_mqtt_5:
            first = await reader.readuntil(b"MQTT") + await reader.readexactly(1)
            if first[-1] == 5:
                writer.write(_UNSUPPORTED_VERSION)
                writer.close()
                return
        from_broker, to_broker = await asyncio.open_connection("127.0.0.1", self._port, limit=_PIECE_BYTES)
        self._writers += [writer, to_broker]
        to_broker.write(first)
        for one, other in ((reader, to_broker), (from_broker, writer)):
            task = asyncio.create_task(self._pipe(one, other, limited=other is to_broker))
            self._pipes.add(task)
            task.add_done_callback(self._pipes.discard)

    async def _pipe(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, limited: bool) -> None:
        writer.transport.set_write_buffer_limits(high=_PIECE_BYTES)
        try:
            while data := await reader.read(_PIECE_BYTES):
                writer.write(data)
                await writer.drain()
                if limited and self.bytes_per_s is not None:
                    await asyncio.sleep(len(data) / self.bytes_per_s)
        except ConnectionError:
            pass
        finally:
            writer.close()


@asynccontextmanager
async def relay(broker_url: str, *, refuse_mqtt_5: bool = False) -> AsyncIterator[Relay]:
    made = Relay(broker_url, refuse_mqtt_5)
    server = await made.start()
    try:
        yield made
    finally:
        server.close()
        await made.stop()
        made.cut()
