"""Fields of messages as columns: names, units, kinds."""

import pytest

from resonator_daemon.exporting.columns import sources, with_axis
from resonator_daemon.publishing.payloads import ContactEvent, Contacts, Health, Patch


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


def test_columns_of_a_message_with_parts_and_vectors() -> None:
    columns = {source.column.name: source.column for source in sources(ContactEvent)}
    assert columns["t_ns"].data_type == columns["contact_since_t_ns"].data_type == "uint64"
    assert columns["seq"].data_type == columns["lost_link_gap"].data_type == "int64"
    assert (columns["board_ticks"].data_type, columns["board_ticks"].nullable) == ("uint64", True)
    assert (columns["event"].data_type, columns["contact_status"].data_type, columns["replayed"].data_type) == (
        "text",
        "text",
        "bool",
    )
    assert columns["contact_position_std_x_m"].data_type == "float64"
    assert columns["contact_at_least_newton"].nullable
    assert not columns["contact_force_newton"].nullable
    assert columns["contact_position_y_m"].description.startswith("y: x and y in the plate's plane")


def test_what_has_no_fixed_length_is_no_column() -> None:
    with pytest.raises(ValueError, match=r"contacts is tuple.*, which is no column"):
        list(sources(Contacts))
    with pytest.raises(ValueError, match=r"records_unusable is dict"):
        list(sources(Health))


def test_the_components_of_a_vector_that_is_missing_are_missing() -> None:
    get = {source.column.name: source.get for source in sources(Patch)}
    assert get["moment_y_newton_m"](Patch.model_construct(moment_newton_m=None)) is None
