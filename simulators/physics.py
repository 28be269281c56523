"""What an emulated plate does beside eq. (1), as the [plate] table of a scenario sets it."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False, strict=True)]
Share = Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False, strict=True)]
Relative = Annotated[float, Field(ge=0, le=1e-3, allow_inf_nan=False, strict=True)]  # of a frequency
Decibel = Annotated[float, Field(ge=-300, le=0, allow_inf_nan=False, strict=True)]  # below full scale

_IDEAL = {
    "hysteresis_fraction": 0.0,
    "creep_fraction": 0.0,
    "temperature_coefficient": 0.0,
    "temperature_coefficient_std": 0.0,
    "temperature_quadratic": 0.0,
    "temperature_cubic": 0.0,
    "temperature_transient_s": 0.0,
    "ageing": 0.0,
    "sensitivity_scatter": 0.0,
    "flicker_fm": 0.0,
    "random_walk_fm": 0.0,
}


class Physics(BaseModel):
    """Imperfections of a plate's sites and of its oscillators; `ideal = true` switches off all that is not given."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    ideal: Annotated[bool, Field(strict=True)] = False
    hysteresis_fraction: Share = 0.01  # half width of the play, of the plate's largest force
    creep_fraction: Share = 0.005
    creep_time_s: Positive = 20.0
    temperature_coefficient: Number = -5e-8  # 1/K, mean over the sites; where the plate file does not give them
    temperature_coefficient_std: NotNegative = 5e-8  # 1/K, from site to site
    temperature_quadratic: Number = -0.5e-9  # 1/K^2
    temperature_cubic: Number = 1.08e-10  # 1/K^3
    temperature_transient_s: Number = -2e-7  # relative shift for each K/s
    contact_time_s: Positive = 5.0  # in which a site takes the temperature of what touches it, and of the plate
    ageing: Number = 2e-7  # relative shift for each e-fold of 1 + t / 1 day
    sensitivity_scatter: Share | None = None  # relative, of K from touch to touch and corner; None: as calibrated
    white_fm: Relative = 3e-10  # Allan deviation at 1 s
    flicker_fm: Relative = 1e-10  # Allan deviation, at any time
    random_walk_fm: Relative = 2e-12  # Allan deviation at 1 s
    jitter_s: Annotated[float, Field(ge=0, le=1e-6, strict=True)] = 0.3e-9  # of the counter's input
    pilot_level_db: Decibel = -85.0
    noise_level_db: Decibel = -100.0
    full_contact_newton: Positive = 0.02  # from here on a touched site sounds at its full level
    reference_error: Annotated[float, Field(ge=-0.1, le=0.1, strict=True)] = (
        1.5e-6  # the board's reference oscillator is that much fast
    )
    drop_rate: Annotated[float, Field(ge=0, lt=1, strict=True)] = 0.0  # share of frames that the board loses

    @model_validator(mode="before")
    @classmethod
    def _ideal_where_not_given(cls, given: Any) -> Any:
        return {**_IDEAL, **given} if isinstance(given, dict) and given.get("ideal") is True else given
