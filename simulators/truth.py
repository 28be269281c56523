"""The truth file: what pressed during each frame, one JSON object a line, beside what the daemon measured."""

import json

from simulators.board import MadeFrame
from simulators.plate import PLATE_KELVIN, Contact


def truth_line(frame: MadeFrame, t_ns: int) -> str:
    """Return the line of a frame whose gate ended at `t_ns`, UTC."""
    truth = {
        "sequence": frame.sequence,
        "board_ticks": frame.board_ticks,
        "t_ns": str(t_ns),
        "contacts": [_contact(contact) for contact in frame.contacts],
        "plate_kelvin": PLATE_KELVIN,
    }
    return json.dumps(truth) + "\n"


def _contact(contact: Contact) -> dict[str, object]:
    truth = contact._asdict()
    if contact.friction_coefficient is None:
        del truth["friction_coefficient"], truth["stick_radius_m"]
    return truth
