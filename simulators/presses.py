"""Touches that clients press and release while the emulator runs: requests are checked, what is held presses on."""

import json
import math
from collections.abc import Callable
from itertools import count
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from simulators.arrays import Floats
from simulators.findings import message_of
from simulators.pressing import FRICTION_COEFFICIENT, RADIUS_M_AT_1_NEWTON, Pressing
from simulators.scenario_file import reach_m, site_at

FIRST_ID = 1_000_001  # of a contact; those of scenarios begin at 1
TOUCHES_MAX = 16  # of all clients
FORCE_RANGE = 2.0  # times the plate's largest force, so that overload can be tried
RADIUS_MIN_M, RADIUS_MAX_M = 1e-4, 8e-3  # of a contact with a skin
FRICTION_MAX = 2.0

_STILL_NEWTON = (0.0, 0.0, 0.0)

Name = Annotated[str, Field(min_length=1, max_length=64, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]


class RefusedRequest(Exception):  # noqa: N818  # an answer to a client, no error of the emulator
    """A request that changes nothing: `code` for programs, the message for people."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class PressRequest(BaseModel):
    """Begin a touch, or change one that is held: keys that are not given stay."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    press: Name
    position_m: tuple[Finite, Finite] | None = None
    force_newton: tuple[Finite, Finite, Finite] | None = None
    radius_m: Finite | None = None  # None: as the force has it
    friction_coefficient: Finite | None = None


class ReleaseRequest(BaseModel):
    """End a touch."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    release: Name


class InfoRequest(BaseModel):
    """Describe the plate."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    info: Literal[True]


class TruthRequest(BaseModel):
    """Return what presses the plate, scenario included."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    truth: Literal[True]


REQUESTS: Final[dict[str, type[BaseModel]]] = {
    "press": PressRequest,
    "release": ReleaseRequest,
    "info": InfoRequest,
    "truth": TruthRequest,
}


class _Press(NamedTuple):
    """A touch that is held."""

    id: int
    position_m: tuple[float, float]
    force_newton: tuple[float, float, float]
    radius_m: float | None
    friction_coefficient: float

    @property
    def radius_m_at_1_newton(self) -> float:
        if self.radius_m is None or not self.force_newton[2]:
            return RADIUS_M_AT_1_NEWTON
        return float(self.radius_m / np.cbrt(self.force_newton[2]))

    @property
    def slides(self) -> bool:
        """Whether friction cannot bear the tangential force."""
        return math.hypot(*self.force_newton[:2]) >= self.friction_coefficient * self.force_newton[2] > 0.0

    @property
    def acting_newton(self) -> tuple[float, float, float]:
        """What acts on a skin: friction bounds the tangential force."""
        x, y, z = self.force_newton
        share = self.friction_coefficient * z / math.hypot(x, y) if self.slides else 1.0
        return x * share, y * share, z


class Presses:
    """The touches that clients hold on one plate; each client names its own.

    Attributes
    ----------
    truth
        Returns the truth of the newest frame, as a line of the truth file; None: there is no frame yet.
    """

    def __init__(self, plate: Plate, serial_number: str) -> None:
        self.truth: Callable[[], dict[str, Any] | None] = lambda: None
        self._plate = plate
        self._serial_number = serial_number
        self._low_m, self._high_m = reach_m(plate)
        self._has_skin = FORCE_SIGNAL not in plate.signals
        self._force_max_newton = FORCE_RANGE * plate.force_max_newton
        self._held: dict[tuple[int, str], _Press] = {}
        self._ids = count(FIRST_ID)
        self._sites: dict[tuple[float, float], int | None] = {}  # at the places of the touches
        self._pressing = self._arrays()

    def request(self, client: int, line: bytes) -> dict[str, Any]:
        """Apply a line of a client; return the answer."""
        try:
            return {"ok": True} | self._apply(client, line)
        except RefusedRequest as refused:
            return {"ok": False, "error": {"code": refused.code, "message": str(refused)}}

    def release_all(self, client: int) -> None:
        """End all touches of a client."""
        self._held = {key: press for key, press in self._held.items() if key[0] != client}
        self._pressing = self._arrays()

    @property
    def held(self) -> bool:
        """Whether a client holds a touch."""
        return bool(self._held)

    def at(self, moments: int) -> Pressing:
        """Return what is held now, for each of so many moments."""
        return Pressing._make(
            values if values.ndim == 1 else np.broadcast_to(values, (moments, *values.shape[1:]))
            for values in self._pressing
        )

    def site_at(self, position_m: tuple[float, float]) -> int | None:
        """Return the id of the site that is exactly at the place of a touch, None where none is."""
        return self._sites.get(position_m)

    def _apply(self, client: int, line: bytes) -> dict[str, Any]:
        try:
            content = json.loads(line)
        except (ValueError, RecursionError):  # not UTF-8, too
            raise RefusedRequest("not_json", "a request is one line with a JSON object") from None
        verbs = [verb for verb in REQUESTS if verb in content] if isinstance(content, dict) else []
        if len(verbs) != 1:
            forms = '{"press": NAME, ...}, {"release": NAME}, {"info": true} or {"truth": true}'
            raise RefusedRequest("no_verb", f"a request is {forms}")
        try:
            request = REQUESTS[verbs[0]].model_validate(content)
        except ValidationError as error:
            raise _refused(error.errors()[0]) from None
        match request:
            case PressRequest():
                return self._press(client, request)
            case ReleaseRequest():
                return self._release(client, request.release)
            case InfoRequest():
                return self._info()
            case _:
                return {"truth": self.truth()}

    def _info(self) -> dict[str, Any]:
        return {
            "plate": self._plate.name,
            "serial_number": self._serial_number,
            "low_m": self._low_m.tolist(),
            "high_m": self._high_m.tolist(),
            "force_max_newton": self._force_max_newton,
            "skin": self._has_skin,
        }

    def _release(self, client: int, name: str) -> dict[str, Any]:
        if (press := self._held.pop((client, name), None)) is None:
            raise RefusedRequest("not_pressed", f"this connection holds no touch {name!r}")
        self._pressing = self._arrays()
        return {"release": name, "contact_id": press.id}

    def _press(self, client: int, request: PressRequest) -> dict[str, Any]:
        key, now = (client, request.press), self._held.get((client, request.press))
        position_m = request.position_m or (now.position_m if now else None)
        if position_m is None:
            raise RefusedRequest("missing_key", "position_m: missing; the first press of a touch needs it")
        self._check_place(position_m)
        force_newton = request.force_newton or (now.force_newton if now else _STILL_NEWTON)
        self._check_force(force_newton)
        if now is None and len(self._held) >= TOUCHES_MAX:
            raise RefusedRequest("too_many_touches", f"{TOUCHES_MAX} touches are held; release one first")
        radius_m, friction = self._contact(request, now)
        self._held[key] = press = _Press(
            now.id if now else next(self._ids), position_m, force_newton, radius_m, friction
        )
        self._pressing = self._arrays()
        answer: dict[str, Any] = {"press": request.press, "contact_id": press.id}
        return answer | {"slides": press.slides} if self._has_skin else answer

    def _contact(self, request: PressRequest, now: _Press | None) -> tuple[float | None, float]:
        """Return radius, None where the force decides it, and friction coefficient of a touch."""
        given = request.model_fields_set & {"radius_m", "friction_coefficient"}
        if given and not self._has_skin:
            raise RefusedRequest("no_skin", f"{', '.join(sorted(given))}: only for a plate with a skin; leave it out")
        radius_m, friction = (now.radius_m, now.friction_coefficient) if now else (None, FRICTION_COEFFICIENT)
        if "radius_m" in given:
            radius_m = request.radius_m
        if radius_m is not None and not RADIUS_MIN_M <= radius_m <= RADIUS_MAX_M:
            raise RefusedRequest(
                "radius_out_of_range", f"radius_m: got {radius_m}; must be {RADIUS_MIN_M:g} to {RADIUS_MAX_M:g}"
            )
        if request.friction_coefficient is not None:
            friction = request.friction_coefficient
        if not 0.0 <= friction <= FRICTION_MAX:
            raise RefusedRequest(
                "friction_out_of_range", f"friction_coefficient: got {friction}; must be 0 to {FRICTION_MAX:g}"
            )
        return radius_m, friction

    def _check_place(self, position_m: tuple[float, float]) -> None:
        low, high = self._low_m, self._high_m
        if not (np.all(low <= position_m) and np.all(position_m <= high)):
            limits = f"x {low[0]:g} to {high[0]:g}, y {low[1]:g} to {high[1]:g}"
            raise RefusedRequest(
                "outside_plate", f"position_m: got {list(position_m)}; the plate reaches over {limits}"
            )

    def _check_force(self, force_newton: tuple[float, float, float]) -> None:
        limit = self._force_max_newton
        if not 0.0 <= force_newton[2] <= limit or max(map(abs, force_newton)) > limit:
            raise RefusedRequest(
                "force_out_of_range",
                f"force_newton: got {list(force_newton)}; z must be 0 to {limit:g}, x and y -{limit:g} to {limit:g}",
            )

    def _arrays(self) -> Pressing:
        held = list(self._held.values())
        self._sites = {press.position_m: site_at(np.array(press.position_m), self._plate) for press in held}
        return Pressing(
            np.array([[press.id for press in held]], dtype=np.int64),
            _rows([press.acting_newton if self._has_skin else press.force_newton for press in held], 3),
            _rows([press.position_m for press in held], 2),
            np.full((1, len(held)), np.nan),
            np.zeros(len(held), dtype=np.bool_),
            np.array([press.radius_m_at_1_newton for press in held]),
            np.array([press.friction_coefficient for press in held]),
        )


def _rows(values: list[Any], width: int) -> Floats:
    return np.array(values, dtype=np.float64).reshape(1, -1, width)


def _refused(error: ErrorDetails) -> RefusedRequest:
    key = ".".join(map(str, error["loc"]))
    if error["type"] == "extra_forbidden":
        return RefusedRequest("unknown_key", f"{key}: unknown key; leave it out")
    return RefusedRequest(
        "not_finite" if error["type"] == "finite_number" else "bad_value", f"{key}: {message_of(error)}"
    )
