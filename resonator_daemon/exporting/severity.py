"""How bad a state is, for viewers that colour what they show."""

from enum import IntEnum

from resonator_daemon.publishing.payloads import Condition


class Severity(IntEnum):
    """In the numbers of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


def severity(state: Condition) -> Severity:
    """Return how bad it is: an error must be mended, and a warning may pass."""
    match state:
        case Condition.ONLINE | Condition.STARTING:
            return Severity.OK
        case Condition.REFUSED:
            return Severity.ERROR
    return Severity.WARN
