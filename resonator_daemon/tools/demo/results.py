"""The result of a demo as a JSON object and as text: what makes it a failure, and how busy the computer was."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from resonator_daemon.tools.demo.score import FOUND_WITHIN_NS, PlateScore
from resonator_daemon.tools.view.words import losses_in_words

_LATE_MS: Final = FOUND_WITHIN_NS * 1e-6
_SKIPPED: Final = "skipped_late"  # results that newer ones replaced: no frame is lost
_DROPPED: Final = "publish_dropped"  # counts messages; all other causes count frames
_FEW: Final = 1e-3  # of the frames: so few that are not decoded need no remedy
_ERRORS: Final = (  # rms, as text
    ("force", "force_error_newton_rms", 1e3, "mN"),
    ("place", "position_error_mm_rms", 1.0, "mm"),
    ("traction", "traction_error", 100.0, "%"),
)


def plate_result(score: PlateScore, until_ns: int, *, has_skin: bool) -> dict[str, Any]:
    """Return the result of one plate, without processor time and memory."""
    accuracy = score.accuracy(until_ns)
    losses = score.losses
    return {
        "frames": score.frames,
        "lost": score.lost,
        "frame_rate_hz": _frame_rate_hz(score.health),
        "latency_ms": percentiles(accuracy.latency_ms),
        "contacts_true": accuracy.touches,
        "contacts_found": accuracy.found,
        "contacts_by_hand": len(score.by_hand),  # through the control socket, as in the live page: not scored
        "contacts_late": len(accuracy.late_ms),
        "latest_contact_ms": _rounded(max(accuracy.late_ms, default=None)),
        "sites_right": None if has_skin else accuracy.found,  # a skin is touched anywhere
        "force_error_newton_rms": _rounded(accuracy.force_error_newton_rms),
        "position_error_mm_rms": _rounded(accuracy.position_error_m_rms, 1e3),  # None: the position is the site's
        "decoded_frames": score.decoded_frames if has_skin else None,
        "frames_not_decoded": losses["not_decoded"] if has_skin else None,
        "traction_error": _rounded(accuracy.traction_error),
        "parts_lost": losses["parts"],
        "messages_missed": score.messages_missed,
    }


def percentiles(latency_ms: list[float]) -> dict[str, float] | None:
    """Return median and 99 % of latencies in ms; None if there are none."""
    if not latency_ms:
        return None
    p50, p99 = np.percentile(latency_ms, [50, 99])
    return {"p50": round(float(p50), 2), "p99": round(float(p99), 2)}


def failures(plate: Mapping[str, Any]) -> list[str]:
    """Return a clause for each failure of a plate's run: touches that were missed, frames that were lost."""
    clauses = [
        f"{count} {'messages' if cause == _DROPPED else 'frames'} lost ({cause})"
        for cause, count in plate["lost"].items()
        if count and cause != _SKIPPED
    ]
    if not plate["frames"]:
        clauses.append("no frame was received")
    if plate["decoded_frames"] == 0:
        clauses.append("no frame was decoded")
    if missed := plate["contacts_true"] - plate["contacts_found"]:
        at_site = "" if plate["sites_right"] is None else " at the right site"
        clauses.append(
            f"{missed} of {plate['contacts_true']} touches missed: "
            f"no onset event{at_site} dated within {_LATE_MS:g} ms of it"
        )
    return clauses


def delays(plate: Mapping[str, Any]) -> list[str]:
    """Return a clause for each kind of result that was late or skipped, which is no failure."""
    clauses, frames = list[str](), plate["frames"]
    if (skipped := plate.get("frames_not_decoded") or 0) > _FEW * frames:
        clauses.append(f"{skipped} of {frames} frames not decoded ({100 * skipped / frames:.1f} %)")
    if (missed := plate["messages_missed"] - skipped) > 0:
        clauses.append(f"{missed} results skipped or not received")
    if late := plate["contacts_late"]:
        touches, most_ms = plate["contacts_true"], plate["latest_contact_ms"]
        clauses.append(f"{late} of {touches} touches more than {_LATE_MS:g} ms late (up to {most_ms:.0f} ms)")
    if plate["latency_ms"] and plate["latency_ms"]["p99"] > _LATE_MS:
        clauses.append(f"99 % of messages within {plate['latency_ms']['p99']:.0f} ms")
    return clauses


def cause(load: str, *, overloaded: bool) -> tuple[str, str]:
    """Return why results were late or lost, by the load of the computer, and what to do."""
    if overloaded:
        return (
            f"cause: this computer is overloaded: {load}",
            "remedy: end other programs and repeat the demo, or run one plate: resonatord demo --plate quartz16",
        )
    return (
        f"cause: not the average load of this computer, a short one is possible: {load}",
        "remedy: repeat the demo; if this happens again, open an issue with the output of resonatord demo --json",
    )


def in_words(result: Mapping[str, Any]) -> str:
    """Return a line of text for each plate, and one for each with touches by hand."""
    lines = []
    for name, plate in result["plates"].items():
        skipped = {_SKIPPED: 0, "not_decoded": plate["frames_not_decoded"] or 0}
        lost = losses_in_words(plate["lost"] | skipped | {"parts": plate["parts_lost"]})
        at_site = "" if plate["sites_right"] is None else " at the right site"
        clauses = [f"{plate['contacts_found']} of {plate['contacts_true']} touches{at_site}"]
        for what, key, scale, unit in _ERRORS:
            if (error := plate[key]) is not None:
                clauses.append(f"{what} ± {scale * error:.2g} {unit}")
        if latency := plate["latency_ms"]:
            clauses.append(f"latency {latency['p50']} ms (99 %: {latency['p99']} ms)")
        lines.append(f"{name}: {plate['frames']} frames at {plate['frame_rate_hz']}/s, {lost}; {', '.join(clauses)}")
        if by_hand := plate["contacts_by_hand"]:
            lines.append(f"{name}: {by_hand} touches by hand, not scored; nor are others at the same time")
    return "\n".join(lines) + "\n"


def _frame_rate_hz(health: list[Mapping[str, Any]]) -> float | None:
    if len(health) < 2:
        return None
    first, last = health[0], health[-1]
    frames, seconds = last["frames"] - first["frames"], last["uptime_s"] - first["uptime_s"]
    return round(float(frames / seconds), 1)


def _rounded(value: float | None, scale: float = 1.0) -> float | None:
    return None if value is None else round(scale * value, 5)
