"""How a plan ends without a plate file."""

from resonator_daemon.errors import ExitCode, UserError


class PlanRefusedError(UserError):
    """The plan cannot be fulfilled; no plate file was written."""

    exit_code = ExitCode.FAILED
    code = "no_plan"
