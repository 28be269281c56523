from pathlib import Path

import pytest
from brokers import Mosquitto
from service_bench import Bench


@pytest.fixture
def bench(tmp_path: Path, mosquitto: Mosquitto) -> Bench:
    """A daemon at Mosquitto, and its emulated board."""
    return Bench(tmp_path, mosquitto.url)
