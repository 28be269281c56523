"""`resonatord check` refuses what setting up a run refuses, with the same text: a corpus of bad values."""

import asyncio
import copy
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit

from resonator_daemon.base.errors import ConfigurationError, ExitCode
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.values import plate_text
from resonator_daemon.commands import main
from resonator_daemon.daemon.service.config_store import ConfigStore, load_checked
from resonator_daemon.daemon.service.daemon import Service
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder
from resonator_daemon.measure.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.measure.sensors.surface_requests import SurfaceSettings

BAD = (0, -1, 1e-300, 1e300, math.nan, math.inf, 10**400, [], "1")
CONFIG: dict[str, Any] = {
    "plate": "plate.toml",
    "link": "tcp://127.0.0.1:9",
    "measurement": {"window_ms": 10.0, "step_ms": 5.0},
    "decoding": {"method": "open-plane", "contact_physics": False, "friction_coefficient": 0.5},
    "recording": {"file_max_mb": 1.0, "file_max_minutes": 1.0, "max_total_mb": 10.0, "min_free_mb": 1.0},
}
SKINS = [  # shape of the grid, depth, pitch, method
    *(([5, 8], 1.0, pitch_mm, "open-plane") for pitch_mm in (1e-300, 1e-9, 0.4)),
    *(([5, 8], depth_mm, 0.4, "open-plane") for depth_mm in (0.001, 0.007)),
    *((shape, 1.0, 0.3, method) for shape in ([1, 1], [1, 39], [1, 40]) for method in ("open-plane", "fourier")),
    ([5, 8], 1.0, 0.4, "fourier"),
]


def plate(name: str) -> dict[str, Any]:
    content = tomlkit.parse(plate_text(load_plate(name))).unwrap()
    if "grid" in content:
        content["grid"] |= {"shape": [5, 8], "order": [1, 8, 40]}
        return content
    response = {"hysteresis_newton": 0.01, "creep_fraction": 0.01, "creep_time_s": 10.0, "relative_std": 0.1}
    return content | {"sites": content["sites"][:4], "response": response}


def with_bad_values(content: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the content with each number, and each list, replaced by each bad value; of a list's items the first."""

    def paths(value: object, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        items = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
        for key, item in items:
            yield from paths(item, (*path, key))
        if isinstance(value, int | float | list):
            yield path

    for *parents, last in paths(content):
        for bad in BAD:
            changed = table = copy.deepcopy(content)
            for key in parents:
                table = table[key]
            table[last] = bad
            yield changed


def refusals_of_run(path: Path) -> tuple[str, ...]:
    """Set up all that a run makes of its files, except link and broker."""
    store = ConfigStore(path, path.parent / "last-good")
    made: list[SurfaceSettings] = []
    try:
        config = load_checked(path)

        async def set_up() -> None:
            Service(store)

        asyncio.run(set_up())
    except ConfigurationError as error:
        return error.messages
    BoardPipeline(config, "id", lambda *_: None, make_decoding=lambda it, _: made.append(it))  # type: ignore
    for settings in made:
        noise_std = np.full((3, len(settings.skin.site_positions_m)), 1e-4)
        SkinDecoder(settings.skin, settings.options, noise_std, lambda _step: None)
    return ()


def check_agrees(folder: Path, config: object, plate: object, capsys: pytest.CaptureFixture[str]) -> bool:
    """Return whether both accept."""
    (folder / "plate.toml").write_text(tomlkit.dumps(plate))  # type: ignore[arg-type]
    (folder / "board.toml").write_text(tomlkit.dumps(config))  # type: ignore[arg-type]
    code = main(["check", str(folder / "board.toml"), "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert tuple(answer["errors"]) == refusals_of_run(folder / "board.toml")
    assert code == (ExitCode.CONFIG if answer["errors"] else ExitCode.DONE)
    return code == ExitCode.DONE


@pytest.mark.parametrize("name", ["quartz16", "comb16", "skin32"])
def test_a_bad_plate_value_is_refused_by_both(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = plate(name)
    assert check_agrees(tmp_path, CONFIG, good, capsys)
    for bad in with_bad_values(good):
        check_agrees(tmp_path, CONFIG, bad, capsys)


def test_a_bad_value_of_a_configuration_is_refused_by_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for bad in with_bad_values(CONFIG):
        check_agrees(tmp_path, bad, plate("quartz16"), capsys)


def test_a_skin_that_cannot_be_decoded_is_refused_by_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    accepted = []
    for shape, depth_mm, pitch_mm, method in SKINS:
        content = plate("skin32")
        content["skin"]["depth_mm"] = depth_mm
        content["grid"] |= {"shape": shape, "pitch_mm": pitch_mm, "order": [1, shape[1], shape[0] * shape[1]]}
        config = CONFIG | {"decoding": CONFIG["decoding"] | {"method": method}}
        if check_agrees(tmp_path, config, content, capsys):
            accepted.append((shape, depth_mm, pitch_mm, method))
    assert accepted == [
        ([5, 8], 1.0, 0.4, "open-plane"),
        ([1, 40], 1.0, 0.3, "open-plane"),
        ([5, 8], 1.0, 0.4, "fourier"),
    ]
