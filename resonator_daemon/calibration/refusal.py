"""How a calibration ends without a result."""

from resonator_daemon.errors import ExitCode, UserError


class CalibrationRefusedError(UserError):
    """The plate, its surroundings or who loads it do not allow a calibration; nothing was changed."""

    exit_code = ExitCode.FAILED
    code = "not_calibrated"


class LinkBusyError(UserError):
    """The port cannot be opened now, as while the daemon runs on it."""

    exit_code = ExitCode.UNAVAILABLE

    def __init__(self, message: str, *, in_use: bool) -> None:
        super().__init__(message)
        self.code = "port_in_use" if in_use else "no_board"
