"""TCP proxy between the daemon and its broker that can be closed, or limited to some bytes per second."""

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

_PIECE_BYTES = 4096
_KERNEL_BUFFER_BYTES = 16_384  # otherwise the kernel buffers megabytes before a sender has to wait


class Gate:
    """Forwards TCP connections while open; `bytes_per_s` limits what goes to the broker."""

    def __init__(self, broker_port: int) -> None:
        self._broker_port = broker_port
        self._connections: set[asyncio.Task[None]] = set()
        self.port = 0
        self.opened = True
        self.bytes_per_s: float | None = None

    def shut(self) -> None:
        """End all connections and accept no new one."""
        self.opened = False
        for connection in self._connections:
            connection.cancel()

    @asynccontextmanager
    async def standing(self) -> AsyncIterator["Gate"]:
        listener = socket.create_server(("127.0.0.1", 0))
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BUFFER_BYTES)  # connections inherit it
        self.port = listener.getsockname()[1]
        server = await asyncio.start_server(self._accept, sock=listener, limit=_PIECE_BYTES)
        try:
            yield self
        finally:
            self.shut()
            server.close()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is None:
            raise RuntimeError("connections are served by tasks")
        self._connections.add(task)
        try:
            if self.opened:
                await self._serve(reader, writer)
        except (OSError, asyncio.CancelledError):
            pass  # one side has disconnected, or the gate was shut: both connections end
        finally:
            writer.transport.abort()
            self._connections.discard(task)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        broker_reader, broker_writer = await asyncio.open_connection("127.0.0.1", self._broker_port, limit=_PIECE_BYTES)
        ways = [
            asyncio.create_task(self._forward(reader, broker_writer, narrow=True)),
            asyncio.create_task(self._forward(broker_reader, writer, narrow=False)),
        ]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            broker_writer.transport.abort()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, narrow: bool) -> None:
        writer.transport.set_write_buffer_limits(high=_PIECE_BYTES)
        with suppress(OSError):
            while data := await reader.read(_PIECE_BYTES):
                writer.write(data)
                await writer.drain()
                if narrow and self.bytes_per_s is not None:
                    await asyncio.sleep(len(data) / self.bytes_per_s)
