"""Faults as text and as a plan."""

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
