"""Reasons in recordings: recordings of earlier versions have the sentence alone."""

from typing import Annotated, Any

from pydantic import BeforeValidator

from resonator_daemon.base.reasons import Reason, ReasonCode


def _complete(stored: Any) -> Reason:
    """Return a stored reason with a code that this version has."""
    match stored:
        case str():
            return Reason(ReasonCode.UNSPECIFIED, stored)
        case [str() as code, str() as text]:
            return Reason(ReasonCode(code), text)
    raise ValueError("a reason is [code, text]")


StoredReason = Annotated[Reason, BeforeValidator(_complete)]
"""A reason that is written as [code, text]; a text alone can be read, too."""
