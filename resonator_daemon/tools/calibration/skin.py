"""`resonatord calibrate skin`: depth, modulus and common gain of a skin, from a ball of known weight put on it."""

import asyncio
import math
import secrets
from collections.abc import Iterator
from contextlib import aclosing
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomlkit

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.host.text import print_note
from resonator_daemon.board.config import Config, load_config
from resonator_daemon.estimate.surface.fitting.ball_fit import Press, SkinFit, fit_skin
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_contacts import RADIUS_SHARE, SkinContact
from resonator_daemon.estimate.surface.streaming import StreamingDecoder
from resonator_daemon.measure.sensors.surface_requests import stated_skin
from resonator_daemon.mqtt.payloads import Signals
from resonator_daemon.mqtt.requests import reach
from resonator_daemon.mqtt.subscriber import subscribe
from resonator_daemon.mqtt.topics import SIGNALS, TOPICS
from resonator_daemon.tools.calibration.plate_file import table_of
from resonator_daemon.tools.calibration.record import rounded
from resonator_daemon.tools.calibration.run import Ending, finish, report, target_of
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError

_CHI2_MAX: Final = 1.1  # of a press: above it, it is not that of a ball, ...
_CHI2_STD: Final = 4.0  # ... nor by less than so many standard deviations, which few signals have large
_BALL_OFF: Final = 0.1  # relative: by which the ball's radius may differ from what the contacts show
_FRAMES: Final = 25  # of one press, which are averaged
_SPACING_NS: Final = 20_000_000
_STILL: Final = 0.03  # relative change of the force, below which the ball lies ...
_SIGNIFICANT: Final = 4.0  # ... and standard deviations beyond it


@dataclass(frozen=True)
class BallRequest:
    """The ball, its weight, and how often it is put down."""

    ball_radius_m: float
    force_newton: float
    force_std: float = 0.001  # relative
    presses: int = 6


class BallProcedure:
    """Presses of a ball as frames show them, one after the other.

    Parameters
    ----------
    skin
        As stated.
    request

    Attributes
    ----------
    presses
        Those that were accepted.
    """

    def __init__(self, skin: Skin, request: BallRequest) -> None:
        self._skin, self._request = skin, request
        self._radius_max_m = RADIUS_SHARE * float(np.ptp(skin.site_positions_m, axis=0).max())
        self._decoder = StreamingDecoder(skin, DecodingOptions(displacement=False, background=False), lambda _: None)
        self.presses: list[Press] = []
        self._held: list[Floats] = []
        self._first_newton = 0.0
        self._lifted = True

    @property
    def done(self) -> bool:
        return len(self.presses) == self._request.presses

    def push(self, signals: Floats, noise_std: Floats) -> Iterator[tuple[str, str]]:
        """Add a frame, both arrays (3, n); yield event and sentence of what changes."""
        if not self._decoder.prepare(noise_std):
            return
        self._decoder.decode_map(signals, noise_std)
        contacts = self._decoder.read_contacts().contacts
        if not contacts:
            if not self._lifted or self._held:
                self._lifted, self._held = True, []
                yield "lifted", self.request_next()
        elif self._lifted:
            yield from self._add(contacts, signals, noise_std)

    def request_next(self) -> str:
        """Return what to do for the next press."""
        number = f"press {len(self.presses) + 1} of {self._request.presses}"
        return f"{number}: put the ball anywhere well inside the sites and leave it"

    def fit(self) -> SkinFit:
        """Fit all presses at once."""
        return fit_skin(self._skin, self.presses, self._radius_max_m)

    def _add(self, contacts: tuple[SkinContact, ...], signals: Floats, noise_std: Floats) -> Iterator[tuple[str, str]]:
        patch = contacts[0].patch
        newton, std_newton = float(patch.force_newton[2]), float(patch.force_std_newton[2])
        moved = abs(newton - self._first_newton) > _STILL * newton + _SIGNIFICANT * std_newton
        if len(contacts) > 1 or not self._held or moved:
            self._held, self._first_newton = [], newton
        self._held.append(signals)
        if len(self._held) < _FRAMES:
            return
        self._lifted = False
        mean = np.mean(self._held, axis=0)
        known = np.isfinite(noise_std) & np.isfinite(mean)
        noise = np.where(known, np.hypot(noise_std / np.sqrt(_FRAMES), self._skin.gain_std * mean), 1.0)
        x_m, y_m = patch.centroid_m.tolist()
        press = Press(np.where(known, mean, np.nan), noise, ContactStart((x_m, y_m), patch.radius_m))
        found = fit_skin(self._skin, [press], self._radius_max_m)
        measured = f"{found.normal_newton[0]:.3f} N, contact radius {1e3 * found.radius_m[0]:.2f} mm"
        measured += f", chi2 {found.chi2[0]:.2f}"
        if patch.at_border:
            yield "rejected", f"{measured}: the contact reaches the border; lift the ball, put it further inside"
        elif found.chi2[0] > (limit := _chi2_max(int(known.sum()))):
            why = f"chi2 above {limit:.2f}: not the contact of a ball that lies still, or sites that fail"
            yield "rejected", f"{measured}: {why}; lift the ball, clean it, put it elsewhere"
        else:
            self.presses.append(press)
            yield "accepted", f"{measured}: accepted" + ("" if self.done else "; lift the ball")


def calibrate_skin(config_path: Path, request: BallRequest, ending: Ending) -> None:
    """Lead through the presses, fit them, and write what they show into the plate file.

    Raises
    ------
    UserError
        The configuration cannot be used or its plate has no skin; no broker can be reached; the presses contradict
        each other or the ball.
    """
    config = load_config(config_path)
    stated = config.plate.required_skin
    file = target_of(config_path, ending)
    procedure = BallProcedure(stated_skin(stated, config.plate.site_positions_m), request)
    asyncio.run(_capture(config, procedure, ending))
    found = procedure.fit()
    gains = found.normal_newton / request.force_newton
    gain, gain_std = float(gains.mean()), math.hypot(gains.std(), request.force_std, found.skin.modulus_std)
    body = found.skin.half_space
    # a^3 = 3 F R (1 - nu^2) / (4 E) (Johnson, Contact Mechanics, section 4.2)
    stiffness = 4.0 / 3.0 * body.youngs_modulus_pascal / (1.0 - body.poisson_ratio**2)
    ball_radius_m = float(np.mean(stiffness * found.radius_m**3 / request.force_newton))
    result: dict[str, Any] = {
        "depth_m": found.skin.depth_m,
        "depth_std_m": found.skin.depth_std_m,
        "youngs_modulus_pascal": body.youngs_modulus_pascal,
        "modulus_std_pascal": found.skin.modulus_std_pascal,
        "gain": gain,
        "gain_std": gain_std,
        "ball_radius_m": ball_radius_m,
        "chi2": found.chi2.tolist(),
    }
    if float(found.chi2.mean()) > _chi2_max(3 * len(config.plate.site_ids)):
        raise CalibrationRefusedError(
            f"the presses contradict each other, chi2 {found.chi2.mean():.2f} together: begin again",
            partial_result=result,
        )
    if abs(ball_radius_m / request.ball_radius_m - 1.0) > _BALL_OFF:
        raise CalibrationRefusedError(
            f"the contacts are those of a ball of radius {1e3 * ball_radius_m:.2f} mm, --ball has "
            f"{1e3 * request.ball_radius_m:g}: check radius and weight of the ball",
            partial_result=result,
        )
    for what, value, std, was in (
        ("depth, mm", 1e3 * found.skin.depth_m, 1e3 * found.skin.depth_std_m, stated.depth_mm),
        ("modulus, Pa", body.youngs_modulus_pascal, found.skin.modulus_std_pascal, stated.youngs_modulus_pascal),
        ("gain", gain, gain_std, 1.0),
    ):
        print_note(f"{what}: {value:.5g} ± {std:.2g} (was {was:g})")
    text = _with_skin(file.source.read_text(encoding="utf-8"), found.skin, gain, gain_std, ending.valid_days)
    finish(config_path, file, text, result, ending)


def _chi2_max(signals: int) -> float:
    return max(_CHI2_MAX, 1.0 + _CHI2_STD * math.sqrt(2.0 / signals))


async def _capture(config: Config, procedure: BallProcedure, ending: Ending) -> None:
    """Push frames of the running daemon until all presses were accepted."""
    await reach(config.mqtt)
    plate, next_ns, count = config.name, 0, len(config.plate.site_ids)
    report({"event": "begin", "presses": 0}, procedure.request_next(), as_json=ending.as_json)
    try:
        topics = (TOPICS[SIGNALS.path],)
        async with asyncio.timeout(ending.timeout_s) as limit, aclosing(subscribe(config.mqtt, topics)) as messages:
            async for name, _, message in messages:
                if not isinstance(message, Signals) or name != (plate or name) or message.t_ns < next_ns:
                    continue
                plate, next_ns = name, message.t_ns + _SPACING_NS
                signals, noise_std = (
                    each.reshape(3, -1).astype(float) for each in (message.signals, message.noise_std)
                )
                if signals.shape[1] != count:
                    raise ConfigurationError(
                        f"plate {plate!r} publishes {signals.shape[1]} sites, the plate file has {count}"
                    )
                for event, text in procedure.push(signals, noise_std):
                    limit.reschedule(asyncio.get_running_loop().time() + ending.timeout_s)
                    report(
                        {"event": event, "presses": len(procedure.presses), "text": text}, text, as_json=ending.as_json
                    )
                if procedure.done:
                    return
    except TimeoutError:
        topic = f"{config.mqtt.prefix}/{plate or '+'}/{SIGNALS.path}"
        why = "no press" if next_ns else f"nothing was published as {topic}; is `resonatord run` running?"
        raise CalibrationRefusedError(f"{why} in {ending.timeout_s:g} s; begin again") from None


def _with_skin(text: str, skin: Skin, gain: float, gain_std: float, valid_days: int) -> str:
    """Return the text of a plate file with a calibration of its skin."""
    document: Any = tomlkit.parse(text)
    found = {
        "youngs_modulus_pascal": skin.half_space.youngs_modulus_pascal,
        "depth_mm": 1e3 * skin.depth_m,
        "depth_std_mm": 1e3 * skin.depth_std_m,
        "modulus_std_pascal": skin.modulus_std_pascal,
        "gain_std_common": gain_std,
    }
    table_of(document, "skin").update(rounded(found))
    tones = [tone for site in document.get("sites", ()) for tone in site["tones"]] or [document["grid"]]
    for tone in tones:
        tone["sensitivity"] = rounded([gain * value for value in tone["sensitivity"]])
    today = datetime.now(UTC).date()
    days = {"date": today, "expiry": today + timedelta(days=valid_days)}
    table_of(document, "calibration").update({"id": secrets.token_hex(8), **days})
    return tomlkit.dumps(document)
