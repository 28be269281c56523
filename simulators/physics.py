"""What an emulated plate does besides eq. (1), as the [plate] table of a scenario sets it."""

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

    ideal: Annotated[bool, Field(strict=True)] = Field(
        False,
        description="Switches off all imperfections below that are not given; white noise, jitter and reference error "
        "stay.",
    )
    hysteresis_fraction: Share = Field(
        0.01, description="Half width of the hysteresis, as a share of the plate's largest force."
    )
    creep_fraction: Share = Field(
        0.005, description="Share of a force that acts on a site with a delay, at its start and at its end."
    )
    creep_time_s: Positive = Field(20.0, description="Time constant of creep.")
    temperature_coefficient: Number = Field(
        -5e-08, description="Relative shift per kelvin, mean over the sites; where the plate file gives none."
    )
    temperature_coefficient_std: NotNegative = Field(
        5e-08, description="Its standard deviation from site to site, 1/K."
    )
    temperature_quadratic: Number = Field(-5e-10, description="Relative shift per square of kelvin.")
    temperature_cubic: Number = Field(1.08e-10, description="Relative shift per cube of kelvin.")
    temperature_transient_s: Number = Field(-2e-07, description="Relative shift for each kelvin per second.")
    contact_time_s: Positive = Field(
        5.0, description="Time constant with which a site takes the temperature of what touches or surrounds it."
    )
    ageing: Number = Field(2e-07, description="Relative shift for each e-fold of 1 + t / 1 day.")
    sensitivity_scatter: Share | None = Field(
        None,
        description="Relative standard deviation of K from touch to touch and corner; left out: the model_error of the "
        "plate file's calibration.",
    )
    white_fm: Relative = Field(3e-10, description="Allan deviation at 1 s of the oscillators' white frequency noise.")
    flicker_fm: Relative = Field(1e-10, description="Allan deviation, at any time, of their flicker frequency noise.")
    random_walk_fm: Relative = Field(2e-12, description="Allan deviation at 1 s of their random-walk frequency noise.")
    jitter_s: Annotated[float, Field(ge=0, le=1e-06, strict=True)] = Field(
        3e-10, description="Standard deviation of an edge at the counter's input."
    )
    pilot_level_db: Decibel = Field(-85.0, description="Level of the pilot tone at every corner, below full scale.")
    noise_level_db: Decibel = Field(-100.0, description="Level of the noise at every corner, below full scale.")
    full_contact_newton: Positive = Field(
        0.02, description="Force from which on a touched site sounds at its full level."
    )
    reference_error: Annotated[float, Field(ge=-0.1, le=0.1, strict=True)] = Field(
        1.5e-06, description="Relative error of the board's reference oscillator; above 0: fast."
    )
    drop_rate: Annotated[float, Field(ge=0, lt=1, strict=True)] = Field(
        0.0, description="Share of its frames that the board loses."
    )

    @model_validator(mode="before")
    @classmethod
    def _ideal_where_not_given(cls, given: Any) -> Any:
        return {**_IDEAL, **given} if isinstance(given, dict) and given.get("ideal") is True else given
