"""Fields of messages as columns: names, units, kinds."""

import pytest

from resonator_daemon.exporting.columns import sources, with_axis
from resonator_daemon.publishing.payloads import Contacts, Health, Patch


@pytest.mark.parametrize(
    ("name", "component"),
    [
        ("position_m", "position_y_m"),
        ("position_std_m", "position_std_y_m"),
        ("moment_newton_m", "moment_y_newton_m"),
        ("force_std_newton", "force_std_y_newton"),
        ("common_mode", "common_mode_y"),
    ],
)
def test_a_component_is_named_before_the_unit(name: str, component: str) -> None:
    assert with_axis(name, "y") == component


def test_what_has_no_fixed_length_is_no_column() -> None:
    with pytest.raises(ValueError, match=r"contacts is tuple.*, which is no column"):
        list(sources(Contacts))
    with pytest.raises(ValueError, match=r"records_unusable is dict"):
        list(sources(Health))


def test_the_components_of_a_vector_that_is_missing_are_missing() -> None:
    get = {source.column.name: source.get for source in sources(Patch)}
    assert get["moment_y_newton_m"](Patch.model_construct(moment_newton_m=None)) is None
