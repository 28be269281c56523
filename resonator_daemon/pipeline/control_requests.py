"""Orders that change how all later frames are measured: they travel with the frames, and are recorded among them."""

import asyncio
import secrets
from collections.abc import Callable
from typing import Annotated, Final, Literal

from pydantic import BaseModel, Field, TypeAdapter

from resonator_daemon.config import Measurement


class Tare(BaseModel):
    """Take the present readings as untouched."""

    verb: Literal["tare"] = "tare"


class MeasureOver(BaseModel):
    """Measure over other windows."""

    verb: Literal["measure_over"] = "measure_over"
    measurement: Measurement


Control = Tare | MeasureOver

_CONTROL: Final[TypeAdapter[Control]] = TypeAdapter(Annotated[Control, Field(discriminator="verb")])


def parse_control(text: str) -> Control:
    """Read an order; ValueError where it is none of this version."""
    return _CONTROL.validate_json(text)


class ControlRequests:
    """Sends orders after the frames that have arrived, and waits until they were obeyed.

    Parameters
    ----------
    send
        Takes a key and an order; the reader gives both back, in their turn.
    """

    def __init__(self, send: Callable[[str, str], None]) -> None:
        self._send = send
        self._asked: dict[str, asyncio.Future[str]] = {}

    async def request(self, control: Control) -> str:
        """Return why the order was not obeyed; "" where it was."""
        key = secrets.token_hex(8)
        asked: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._asked[key] = asked
        try:
            self._send(key, control.model_dump_json())
            return await asked
        finally:
            del self._asked[key]

    def applied(self, key: str, refusal: str) -> None:
        """Take what became of an order; of one that was replayed nobody wants to know."""
        if (asked := self._asked.get(key)) is not None and not asked.done():
            asked.set_result(refusal)
