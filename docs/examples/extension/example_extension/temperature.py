"""Finding of `resonatord doctor`: whether the plate is near room temperature."""

from collections.abc import Iterator

from resonator_daemon.board.config import Config
from resonator_daemon.tools.doctor.capture import Capture
from resonator_daemon.tools.doctor.finding import Amount, Area, Check, Finding

ROOM = Check("example.room", Area.SENSOR, "room temperature")
LIMIT_KELVIN = 313.0


def findings(config: Config | None, capture: Capture | None) -> Iterator[Finding]:
    """Yield one finding; `capture` is None if no board could be measured."""
    if capture is None or not capture.temperatures_kelvin:
        yield ROOM.not_checked("the board reported no temperature")
        return
    highest = max(capture.temperatures_kelvin)
    amount = Amount(highest, LIMIT_KELVIN, "K")
    if highest > LIMIT_KELVIN:
        yield ROOM.warning(f"{highest:.1f} K, at most {LIMIT_KELVIN:g} K", "let the plate cool", amount)
    else:
        yield ROOM.ok(f"{highest:.1f} K", amount)
