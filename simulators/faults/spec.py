"""Faults as one line of text: key=value, separated by commas."""

from typing import get_args

from pydantic import ValidationError

from simulators.faults.plan import LASTING, FaultPlan, Happening
from simulators.findings import message_of, nearest

_RATES = tuple(key for key in FaultPlan.model_fields if key != "events")
_EVENT_KEYS = {
    **{f"{what}_at_s": (what, "at_s") for what in get_args(Happening)},
    **{f"{what}_for_s": (what, "for_s") for what in LASTING},
    "rename_to": ("rename", "to"),
    "tick_step_ticks": ("tick_step", "ticks"),
}
_TEXTS = ("rename_to",)


def parse_faults(spec: str) -> FaultPlan:
    """Read faults: the keys of `FaultPlan`, and for one event of each kind `<what>_at_s`, `<what>_for_s` and so on.

    Raises
    ------
    ValueError
        Unknown key, missing or impossible value; one line for each.
    """
    known = tuple(dict.fromkeys((*_RATES, *_EVENT_KEYS)))
    given: dict[str, object] = {}
    events: dict[str, dict[str, object]] = {}
    findings = []
    for item in filter(None, (part.strip() for part in spec.split(","))):
        key, _, text = (part.strip() for part in item.partition("="))
        if key not in known:
            findings.append(f"faults: {key}: unknown key; {nearest(key, known)}")
            continue
        value = text.split("+") if key == "misbehave" else text if key in _TEXTS else _number(text)
        if key in _RATES:
            given[key] = value
        if key in _EVENT_KEYS:
            what, field = _EVENT_KEYS[key]
            events.setdefault(what, {"what": what})[field] = value
    if "unplug_for_s" in given and "at_s" not in events["unplug"]:
        del events["unplug"]  # it sets the length of random ones
    listed = list(events.values())
    try:
        plan = FaultPlan.model_validate(given | ({"events": listed} if listed else {}))
    except ValidationError as error:
        for finding in error.errors():
            where = finding["loc"]
            if where[0] == "events" and isinstance(where[1], int):
                what = str(listed[where[1]]["what"])
                key = f"{what}_{where[2]}" if len(where) > 2 else what
            else:
                key = str(where[0])
            findings.append(f"faults: {key}: {message_of(finding)}")
    if findings:
        raise ValueError("\n".join(findings))
    return plan


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text  # which the plan refuses with a sentence
