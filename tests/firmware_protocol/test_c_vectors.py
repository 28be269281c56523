"""The vectors that every implementation of the wire must pass, passed by the C reference."""

from typing import Any

import pytest
from c_reference import board_command, event_line, hexadecimal, run_commands
from vector_files import board_of, cases, check_sent, expected_events, named

COMMANDS = {
    "receive": "receive {ticks} {bytes}", "frame": "frame {ticks} {records}", "skip": "skipped", "begin": "begin",
    "connect": "connects {ticks}", "disconnect": "ended", "fault": "fault {ticks} {text}"
}  # fmt: skip


@pytest.mark.parametrize("piece_bytes", [1, 3, 10_000])
def test_streams(piece_bytes: int) -> None:
    commands, expected = [], []
    for case in cases("streams"):
        stream = bytes.fromhex(case["stream"])
        commands.append(f"decoder {128 if case['from_board'] else 0} {case['max_packet_bytes']}")
        commands += [f"receive 0 {stream[at : at + piece_bytes].hex()}" for at in range(0, len(stream), piece_bytes)]
        commands.append("counts")
        expected += [event_line(event) for event in expected_events(case)]
        expected.append("counts " + " ".join(map(str, case["counts"].values())))
    assert run_commands(commands) == expected


@pytest.mark.parametrize("case", cases("board_sessions"), ids=named)
def test_board_sessions(case: dict[str, Any]) -> None:
    commands = [board_command(*board_of(case))]
    for step in case["steps"]:
        text = hexadecimal((step.get("text") or "").encode())
        commands += [
            COMMANDS[step["do"]].format(**{**step, "text": text}),
            f"output {step.get('takes', 10**5)}",
            "state",
        ]
    lines = run_commands(commands)
    served = [line == "served 1" for line in lines if line.startswith("served")]
    assert served == [step["served"] for step in case["steps"] if step["do"] == "connect"]
    printed = [line.split() for line in lines if line.startswith(("output", "state"))]
    for step, sent, state in zip(case["steps"], printed[::2], printed[1::2], strict=True):
        check_sent(step, bytes.fromhex("".join(sent[1:])))
        assert state[1] == step["state"], step
