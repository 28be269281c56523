"""Faults as text and as a plan."""

import pytest

from simulators.faults import FaultEvent, FaultPlan, parse_faults


def test_a_spec_is_read_key_by_key() -> None:
    assert parse_faults("") == FaultPlan()
    plan = parse_faults(
        "bit_error_rate=1e-5, unplug_at_s=2,unplug_for_s=0.5,reboot_at_s=4,garbage_rate_hz=3,split_bytes=7,"
        "misbehave=channels5+same_boot_id, rename_at_s=5,rename_to=board.1,tick_step_ticks=-9,tick_step_at_s=6"
    )
    assert plan == FaultPlan(
        bit_error_rate=1e-5,
        garbage_rate_hz=3.0,
        split_bytes=7,
        unplug_for_s=0.5,
        misbehave=("channels5", "same_boot_id"),
        events=(
            FaultEvent(at_s=2.0, what="unplug", for_s=0.5),
            FaultEvent(at_s=4.0, what="reboot"),
            FaultEvent(at_s=5.0, what="rename", to="board.1"),
            FaultEvent(at_s=6.0, what="tick_step", ticks=-9),
        ),
    )


def test_every_mistake_in_a_spec_is_named() -> None:
    with pytest.raises(ValueError, match="faults") as caught:
        parse_faults(
            "bit_eror_rate=1e-5,unplug_at_s=soon,bit_error_rate=2,reboot_at_s,garbage_rate_hz=nan,noise=1,"
            "burst_bits=17,freeze_for_s=3,rename_at_s=1,rename_to=a/b,tick_step_at_s=1,misbehave=channels5+cheats"
        )
    lines = str(caught.value).splitlines()
    assert len(lines) == 11
    said = dict(line.removeprefix("faults: ").split(": ", 1) for line in lines)
    assert said["bit_eror_rate"] == "unknown key; did you mean bit_error_rate?"
    assert said["unplug_at_s"].startswith("got 'soon'; must be a valid number")
    assert said["bit_error_rate"] == "got 2; must be less than or equal to 1"
    assert said["reboot_at_s"].startswith("got ''")
    assert said["garbage_rate_hz"] == "got nan; must be a finite number"
    assert said["noise"].startswith("unknown key; allowed: bit_error_rate, ")
    assert "16" in said["burst_bits"]
    assert said["freeze_at_s"] == "missing; give a value"
    assert said["rename_to"].startswith("got 'a/b'")
    assert said["tick_step"] == "a tick_step needs ticks, and nothing else takes it"
    assert said["misbehave"].startswith("got 'cheats'; allowed: channels0, channels5, ")
