"""Fields of messages as columns: names, units, kinds."""

import pytest

from resonator_daemon.mqtt.payloads import Contact, Contacts, Health
from resonator_daemon.tools.export.tables import sources


def test_what_has_no_fixed_length_is_no_column() -> None:
    with pytest.raises(ValueError, match=r"contacts is tuple.*, which is no column"):
        list(sources(Contacts))
    with pytest.raises(ValueError, match=r"records_unusable is dict"):
        list(sources(Health))


def test_the_components_of_a_vector_that_is_missing_are_missing() -> None:
    get = {source.column.name: source.get for source in sources(Contact)}
    assert get["moment_y_newton_m"](Contact.model_construct(moment_newton_m=None)) is None
