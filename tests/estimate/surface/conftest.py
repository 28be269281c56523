"""Fixture of the fits of contacts: a model that takes some time to set up."""

import pytest
from contact_scenes import disc_model

from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel


@pytest.fixture(scope="session")
def discs() -> DiscModel:
    return disc_model()
