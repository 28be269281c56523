"""Reasons for states, missing numbers, releases and refusals: a code for programs, a sentence for people."""

from typing import NamedTuple

from resonator_daemon.conditions import Word


class ReasonCode(Word):
    """Why something is as it is; the sentence next to it has the details."""

    # Releases of contacts.
    FORCE_FELL = "force_fell", "the force is below the threshold of release"
    NOT_DETECTED = "not_detected", "the contact is no longer detected"


class Reason(NamedTuple):
    """A code, and a sentence with details.

    Reasons are compared by both; a program that reads messages compares the code alone.
    """

    code: ReasonCode
    text: str
