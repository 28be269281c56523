"""What shall go wrong with an emulated board and its link: the keys of `--faults` and of a scenario's [faults]."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Happening = Literal["unplug", "rename", "freeze", "silence", "reboot", "brown_out", "tick_step", "wrong_board"]
Violation = Literal[
    "channels0",
    "channels5",
    "other_gate",
    "hidden_gate",
    "reference_changes",
    "same_boot_id",
    "limits",
    "other_product",
    "other_plate",
]

LASTING: tuple[Happening, ...] = ("unplug", "freeze", "silence", "wrong_board")

Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False, strict=True)]
Rate = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False, strict=True)]
Duration = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False, strict=True)]
Milliseconds = Annotated[float, Field(ge=0, le=1e5, allow_inf_nan=False, strict=True)]
Bytes = Annotated[int, Field(ge=1, le=65536, strict=True)]
Name = Annotated[str, Field(min_length=1, pattern=r"^[^/]+$", strict=True)]

_MODEL = ConfigDict(extra="forbid", frozen=True)


class FaultEvent(BaseModel):
    """Something that happens to board or link at a moment."""

    model_config = _MODEL

    at_s: Duration = Field(description="When, from the first START.")
    what: Happening = Field(
        description="unplug: the cable is out for a time. rename: the terminal gets another name. freeze: the board "
        "neither answers nor sends, and its gates go on. silence: it answers, and sends no frames. reboot: it starts "
        "again. brown_out: it does so with half a frame sent. tick_step: its tick count jumps. wrong_board: another "
        "board is plugged in for a time."
    )
    for_s: Duration = Field(1.0, description="How long an unplug, freeze, silence or wrong_board lasts.")
    to: Name | None = Field(None, description="Name that a rename gives to the terminal, in the same directory.")
    ticks: Annotated[int, Field(strict=True)] | None = Field(
        None, description="By how much a tick_step moves the count; below 0: backwards."
    )

    @model_validator(mode="after")
    def _complete(self) -> "FaultEvent":
        if (self.to is not None) != (self.what == "rename"):
            raise ValueError("a rename needs to, and nothing else takes it")
        if (self.ticks is not None) != (self.what == "tick_step"):
            raise ValueError("a tick_step needs ticks, and nothing else takes it")
        return self


class FaultPlan(BaseModel):
    """What goes wrong by rate, by script and on purpose. All of it is on the way to the host or at the board."""

    model_config = _MODEL

    bit_error_rate: Share = Field(0.0, description="Share of the bits that arrive flipped.")
    burst_rate_hz: Rate = Field(0.0, description="How often a burst of bits in one packet is damaged.")
    burst_bits: Annotated[int, Field(ge=1, le=16, strict=True)] = Field(
        16, description="Length of such a burst: its first and last bit flip, those between as it happens."
    )
    garbage_rate_hz: Rate = Field(0.0, description="How often 1 to 64 random bytes come between packets.")
    duplicate_rate: Share = Field(0.0, description="Share of the packets that arrive twice.")
    lost_chunk_rate_hz: Rate = Field(0.0, description="How often a run of bytes is lost.")
    lost_chunk_bytes: Bytes = Field(64, description="Longest run that is lost at once.")
    reorder_rate: Share = Field(0.0, description="Share of the packets whose two pieces, cut at random, change places.")
    split_bytes: Bytes | None = Field(
        None, description="Everything is written in pieces of random length, at most that long."
    )
    clump_ms: Milliseconds = Field(
        0.0,
        description="What is sent is held and released at multiples of this, as by the latency timer of an adapter.",
    )
    delay_ms: Milliseconds = Field(0.0, description="Delay of everything.")
    answer_delay_rate: Share = Field(0.0, description="Share of the answers that come late, while others pass.")
    answer_delay_ms: Milliseconds = Field(50.0, description="How late.")
    frame_delay_rate: Share = Field(0.0, description="Share of the frames that come late, while others pass.")
    frame_delay_ms: Milliseconds = Field(5.0, description="How late.")
    slow_reader_bytes_per_s: Rate | None = Field(None, description="The host takes no more than that.")
    unplug_rate_hz: Rate = Field(0.0, description="How often the cable is pulled, at random.")
    unplug_for_s: Duration = Field(1.0, description="How long it is out each time.")
    skew_ppm: Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False, strict=True)] = Field(
        0.0, description="How much faster the board's reference is, in addition to the scenario's reference_error."
    )
    misbehave: tuple[Violation, ...] = Field(
        (),
        description="Protocol violations of the board: channels0, channels5: describes so many. other_gate: "
        "configures twice the gate. hidden_gate: counts half the gate that it confirms. reference_changes: describes "
        "another reference from the second time on. same_boot_id: keeps it over reboots. limits: refuses gates within "
        "them. other_product, other_plate: names another one.",
    )
    events: tuple[FaultEvent, ...] = Field((), description="What happens when.")

    def with_more(self, more: "FaultPlan") -> "FaultPlan":
        """Return this plan with the keys that `more` gives instead of its own, and the events of both."""
        given = {key: getattr(plan, key) for plan in (self, more) for key in plan.model_fields_set}
        return FaultPlan.model_validate(given | {"events": (*self.events, *more.events)})
