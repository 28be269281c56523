"""Requests that change how all later frames are measured: they travel with the frames, and are recorded among them."""

import asyncio
import secrets
from collections.abc import Callable
from typing import Annotated, Final, Literal

from pydantic import BaseModel, Field, TypeAdapter

from resonator_daemon.board.config.tables import Measurement


class Tare(BaseModel):
    """Set the zero to the present readings."""

    verb: Literal["tare"] = "tare"


class SetWindow(BaseModel):
    """Measure over other windows."""

    verb: Literal["measure_over"] = "measure_over"  # as it is in recordings
    measurement: Measurement


Control = Tare | SetWindow

_REQUEST: Final[TypeAdapter[Control]] = TypeAdapter(Annotated[Control, Field(discriminator="verb")])


def parse_request(text: str) -> Control:
    """Return a control request from its JSON; ValueError if it is none of this version."""
    return _REQUEST.validate_json(text)


class ControlRequests:
    """Sends requests after the frames that have arrived, and waits until they were applied.

    Parameters
    ----------
    send
        Called with a key and a request; the reader gives both back, in their turn.
    """

    def __init__(self, send: Callable[[str, str], None]) -> None:
        self._send = send
        self._pending: dict[str, asyncio.Future[str | None]] = {}

    async def apply(self, request: Control) -> str | None:
        """Return why the request could not be applied; None if it was."""
        key = secrets.token_hex(8)
        pending: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()
        self._pending[key] = pending
        try:
            self._send(key, request.model_dump_json())
            return await pending
        finally:
            del self._pending[key]

    def applied(self, key: str, refusal: str | None) -> None:
        """Report what became of a request; for one that was replayed nothing waits."""
        if (pending := self._pending.get(key)) is not None and not pending.done():
            pending.set_result(refusal)
