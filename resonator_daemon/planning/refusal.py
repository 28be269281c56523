"""How a plan ends without a plate file."""

from resonator_daemon.errors import ExitCode, UserError


class PlanRefusedError(UserError):
    """The plan cannot be fulfilled; no plate file was written."""

    exit_code = ExitCode.FAILED


class PlanUsageError(UserError):
    """The options contradict each other or what they name; one message for each finding."""

    exit_code = ExitCode.USAGE
