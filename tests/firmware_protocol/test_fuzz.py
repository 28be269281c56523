"""A short run of what `make fuzz` does for long."""

import random

import fuzz
import pytest

INPUTS = 20_000


@pytest.mark.parametrize("name", fuzz.PARSERS)
def test_no_input_breaks_a_parser(name: str) -> None:
    seen = fuzz.PARSERS[name](INPUTS, random.Random(1))
    expected = {
        "PacketDecoder": {"Packet", "Damage", "ForeignVersion"},
        "HostSession": {"Described", "Started", "Frame", "FramePart", "Rebooted", "Refusal", "Pong", "Located"},
        "DeviceSession": {"IDENTITY", "CONFIGURED", "STARTED", "STOPPED", "PONG", "LOCATED", "REFUSED"},
        "decode_message": {"Identity", "Description", "Configuration", "malformed"},
    }
    assert expected[name] <= set(seen)  # the inputs reach what they are to try
