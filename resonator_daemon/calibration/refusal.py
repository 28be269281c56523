"""How a calibration ends without a result."""

from resonator_daemon.errors import ExitCode, OperatorError


class CalibrationRefusedError(OperatorError):
    """The plate, its surroundings or who loads it do not allow a calibration; nothing was changed."""

    exit_code = ExitCode.FAILED


class CalibrationUsageError(OperatorError):
    """What was asked for contradicts itself or the plate; one message for each finding."""

    exit_code = ExitCode.USAGE


class LinkBusyError(OperatorError):
    """The port cannot be opened now, as while the daemon runs on it."""

    exit_code = ExitCode.UNAVAILABLE
