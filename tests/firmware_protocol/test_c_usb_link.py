"""The RP2040's USB part on a computer: its descriptors, BEGIN, and which of its interfaces serves."""

from itertools import pairwise
from pathlib import Path

import pytest
from c_reference import C_FOLDER, driver, run_driver

TINYUSB = Path(__file__).parents[1] / "firmware" / "tinyusb"
VENDOR_INTERFACE = 2
BEGIN = f"begin {0x41} 1 1 {VENDOR_INTERFACE} 0"


def run(*commands: str) -> list[str]:
    rp2040 = C_FOLDER / "rp2040"
    sources = (str(rp2040 / "usb_link.c"), str(rp2040 / "usb_descriptors.c"))
    return run_driver(driver("usb_driver", *sources, options=(f"-I{TINYUSB}", f"-I{rp2040}")), commands)


def test_descriptors_are_those_of_the_page() -> None:
    configuration, serial = (bytes.fromhex(line.split()[1]) for line in run("descriptors"))
    assert serial[2:].decode("utf-16-le") == "A1B2"
    starts = [0]
    while starts[-1] < len(configuration):
        starts.append(starts[-1] + configuration[starts[-1]])
    assert starts[-1] == len(configuration)
    descriptors = [configuration[a:b] for a, b in pairwise(starts)]
    interfaces = {each[2]: each[5:8] for each in descriptors if each[1] == 4}
    assert configuration[4] == len(interfaces) == 3
    assert interfaces[VENDOR_INTERFACE] == bytes((0xFF, 0x52, 0x01))
    at = next(k for k, each in enumerate(descriptors) if each[1] == 4 and each[2] == VENDOR_INTERFACE)
    endpoints = [(each[2], each[3], each[4] | each[5] << 8) for each in descriptors[at + 1 : at + 3]]
    assert endpoints == [(0x01, 2, 64), (0x81, 2, 64)]
    addresses = [each[2] for each in descriptors if each[1] == 5]
    assert len(set(addresses)) == len(addresses) == 5


@pytest.mark.parametrize(
    ("request_line", "answer", "begins"),
    [
        (BEGIN, "done", "1"),
        (f"begin {0x41} 1 2 {VENDOR_INTERFACE} 0", "stalled", "0"),  # another version
        (f"begin {0x41} 2 1 {VENDOR_INTERFACE} 0", "stalled", "0"),
        (f"begin {0xC1} 1 1 {VENDOR_INTERFACE} 0", "stalled", "0"),
        (f"begin {0x41} 1 1 0 0", "stalled", "0"),
        (f"begin {0x41} 1 1 {VENDOR_INTERFACE} 4", "stalled", "0"),
    ],
)
def test_begin_and_nothing_else_begins(request_line: str, answer: str, begins: str) -> None:
    assert run(request_line, "task", "task") == [answer, begins, "0"]


def test_the_interface_on_which_bytes_came_last_serves() -> None:
    printed = run(
        BEGIN, "task", "vendor 0102", "read", "write 0a0b", "flush",
        "cdc 03", "read", "task", "read", "write 0c", "flush",
        "vendor 04", "read", "task", "read", "write 0d", "flush",
    )  # fmt: skip
    assert printed == [
        "done", "1", "read 0102", "2", "vendor 0a0b", "cdc ",
        "read ", "1", "read 03", "1", "vendor ", "cdc 0c",  # a change is a begin, and comes before its bytes
        "read ", "1", "read 04", "1", "vendor 0d", "cdc ",
    ]  # fmt: skip


def test_what_finds_no_room_is_not_accepted() -> None:
    printed = run(BEGIN, f"write {'55' * 300}", f"write {'66' * 10}", "flush")
    assert printed[1:3] == ["256", "0"]
    assert printed[3] == f"vendor {'55' * 256}"
