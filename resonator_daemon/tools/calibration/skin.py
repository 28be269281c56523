"""`resonatord calibrate skin`: capture what a running daemon publishes of a skin, and fit the decoder's prior to it."""

import asyncio
import json
import sys
from contextlib import aclosing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.errors import ConfigurationError, ExitCode
from resonator_daemon.base.host.text import print_note
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import Skin
from resonator_daemon.board.config import Config, load_config
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.open_plane.prior_fit import PriorFit, fit_prior, has_load
from resonator_daemon.estimate.surface.skin import DEFAULT_PRIOR
from resonator_daemon.mqtt.payloads import Signals
from resonator_daemon.mqtt.requests import reach
from resonator_daemon.mqtt.subscriber import subscribe
from resonator_daemon.mqtt.topics import SIGNALS, TOPICS
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError

FEWEST_FRAMES: Final = 5  # with load
FIRST_FRAME_S: Final = 10.0
_SPACING_NS: Final = 200_000_000  # closer frames of one touch repeat each other
_REPORT_NS: Final = 1_000_000_000


@dataclass
class Capture:
    """Frames of one plate, spaced in time."""

    plate: str | None  # its name in the topics; None before the first message
    frames: list[Floats] = field(default_factory=list)  # (3, n) each
    noise_std: list[Floats] = field(default_factory=list)  # (3,) each
    loaded: int = 0

    def add(self, message: Signals, count: int) -> None:
        """Add a frame whose noise is known."""
        frame = message.signals.reshape(3, -1).astype(np.float64)
        noise = _median_noise(message.noise_std.reshape(3, -1).astype(np.float64))
        if frame.shape[1] != count:
            raise ConfigurationError(
                f"plate {self.plate!r} publishes {frame.shape[1]} sites, the plate file has {count}"
            )
        if not ((noise > 0.0) & np.isfinite(noise)).all():
            return
        self.frames.append(frame)
        self.noise_std.append(noise)
        self.loaded += int(has_load(frame[None], noise)[0])


def calibrate_skin(config_path: Path, seconds: float, *, as_json: bool) -> ExitCode:
    """Capture for some seconds, fit, and print what belongs into the plate file.

    Raises
    ------
    UserError
        The configuration cannot be used or its plate has no skin; no broker can be reached; too few frames have load.
    """
    config = load_config(config_path)
    skin = config.plate.required_skin
    capture = asyncio.run(_capture(config, seconds))
    found: PriorFit | None = None
    if capture.loaded >= FEWEST_FRAMES:
        found = _fit(config.plate, skin, capture)
    captured = {"plate": capture.plate, "frames": len(capture.frames), "frames_with_load": capture.loaded}
    if found is None:
        raise CalibrationRefusedError(
            f"{capture.loaded} of {len(capture.frames)} frames have load, must be at least {FEWEST_FRAMES}: "
            + ("press and shear the skin while they are captured" if capture.frames else _silence(config)),
            partial_result={**captured, "fit": None},
        )
    if as_json:
        result = {"verb": "calibrate", "ok": True, **captured, "fit": _as_json(found)}
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        sys.stdout.write("\n".join([*_lines(found), _gain(found)]) + "\n")
    return ExitCode.DONE


async def _capture(config: Config, seconds: float) -> Capture:
    """Return frames at least 0.2 s apart by their own time, for some seconds from the first one."""
    await reach(config.mqtt)
    capture = Capture(config.name)
    first_ns = next_ns = report_ns = 0
    try:
        topics = (TOPICS[SIGNALS.path],)
        async with asyncio.timeout(FIRST_FRAME_S) as limit, aclosing(subscribe(config.mqtt, topics)) as messages:
            async for plate, _, message in messages:
                if not isinstance(message, Signals) or plate != (capture.plate or plate):
                    continue
                if capture.plate is None or not first_ns:
                    capture.plate, first_ns = plate, message.t_ns
                    limit.reschedule(asyncio.get_running_loop().time() + seconds)
                    print_note(f"plate {plate!r}: press and shear the skin here and there, for {seconds:g} s")
                if message.t_ns >= next_ns:
                    next_ns = message.t_ns + _SPACING_NS
                    capture.add(message, len(config.plate.site_ids))
                if message.t_ns >= report_ns:
                    report_ns = message.t_ns + _REPORT_NS
                    elapsed_s = (message.t_ns - first_ns) * 1e-9
                    print_note(f"{elapsed_s:3.0f} s: {len(capture.frames)} frames, {capture.loaded} with load")
    except TimeoutError:
        pass
    return capture


def _fit(plate: Plate, skin: Skin, capture: Capture) -> PriorFit:
    half_space = HalfSpace(skin.youngs_modulus_pascal, skin.poisson_ratio)
    noise_std = np.median(capture.noise_std, axis=0)

    def progress(tried: int, length_m: float, ratio: float) -> None:
        print_note(f"fit {tried}: correlation length {length_m * 1e3:.2f} mm, tangential ratio {ratio:.2f}")

    try:
        return fit_prior(
            half_space,
            plate.site_positions_m,
            skin.depth_m,
            np.array(capture.frames),
            noise_std,
            gain_std=skin.gain_std,
            progress=progress,
        )
    except ValueError as error:  # the plate file's skin is none that signals can come from
        raise ConfigurationError(f"plate {plate.name!r}: {error}") from error


def _as_json(found: PriorFit) -> dict[str, float | None]:
    """Null for the infinite error of what the frames do not bound."""
    return {key: value if np.isfinite(value) else None for key, value in asdict(found).items()}


def _lines(found: PriorFit) -> list[str]:
    length_mm, length_std_mm = found.correlation_length_m * 1e3, found.correlation_length_std_m * 1e3
    return [
        f"correlation_length_mm = {length_mm:.3g}    # {_error(length_std_mm)}",
        f"tangential_ratio = {found.tangential_ratio:.3g}    # {_error(found.tangential_ratio_std)}",
    ]


def _error(std: float) -> str:
    return f"± {std:.2g}" if np.isfinite(std) else "not bounded by these frames; press and shear in more ways"


def _gain(found: PriorFit) -> str:
    usual = f"{DEFAULT_PRIOR.correlation_length_m * 1e3:g} mm and {DEFAULT_PRIOR.tangential_ratio:g}"
    used = f"# {found.frames_used} frames with load"
    if found.log_evidence_gain < 1.0:
        return f"{used}: no likelier than with the defaults, {usual}."
    return f"{used}: e^{found.log_evidence_gain:.0f} times as likely as with the defaults, {usual}."


def _silence(config: Config) -> str:
    name = config.name or "+"
    return f"nothing usable was published as {config.mqtt.prefix}/{name}/{SIGNALS.path}; is `resonatord run` running?"


def _median_noise(noise_std: Floats) -> Floats:
    """Return the median over the sites of each row, NaN where none is known."""
    rows = (row[np.isfinite(row)] for row in noise_std)
    return np.array([np.median(known) if known.size else np.nan for known in rows])
