"""Reasons that several kinds of sensors give, and reasons as fields of a message."""

from typing import Final, TypedDict

from resonator_daemon.base.reasons import Reason, ReasonCode

BOARD_RESTARTED: Final = Reason(ReasonCode.BOARD_RESTARTED, "the board restarted")
COMMON_MODE_PENDING: Final = Reason(ReasonCode.COMMON_MODE_PENDING, "the common mode is being estimated")
NO_TONE: Final = Reason(ReasonCode.NO_TONE, "no tone is known")


class ReasonFields(TypedDict):
    """The fields of a reason."""

    reason_code: ReasonCode | None
    reason: str | None


def reason_fields(reason: Reason | None) -> ReasonFields:
    """Return the fields of a reason, which None leaves out."""
    return ReasonFields(reason_code=reason.code if reason else None, reason=reason.text if reason else None)
