"""Plates whose sites can be mistaken for each other: refused with the pair, unless the file insists."""

from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest
from command_line import run_command
from plates import plate_head, site

from resonator_daemon.base.plate import Plate, load_plate, shipped_plates
from resonator_daemon.measure.sensors import plate_sites

QUARTZ = load_plate("quartz16")


def plate_text(ppm_apart: float, *, thermal: str = "", **counter: bool) -> str:
    """Three sites with ids 4, 9 and 12: 9 and 12 are so far apart, 4 is far from both."""
    sites = ((4, 9.99e6), (12, 9.98e6), (9, 9.98e6 * (1 - 1e-6 * ppm_apart)))
    return (
        plate_head("three", (-10, -10), (10, 10), **counter)
        + thermal
        + "".join(site(number, 5 * index, 0, force=(f0_hz, -6e-6)) for index, (number, f0_hz) in enumerate(sites))
    )


def check(folder: Path, plate: str, *arguments: str, verb: str = "check") -> CompletedProcess[str]:
    (folder / "plate.toml").write_text(plate)
    config = folder / "board.toml"
    config.write_text('name = "left"\nplate = "plate.toml"\nlink = "tcp://127.0.0.1:9"\n')
    files = ["--config", str(config)] if verb == "run" else [str(config)]
    return run_command(verb, *files, *arguments)


def test_no_shipped_plate_has_codes_that_overlap() -> None:
    for name in shipped_plates():
        assert plate_sites.findings(load_plate(name)) == ()


@pytest.mark.parametrize("verb", ["check", "run"])
def test_codes_that_overlap_are_refused_with_the_ids_and_what_is_needed(tmp_path: Path, verb: str) -> None:
    # 10 N shift by 60 ppm.
    refused = check(tmp_path, plate_text(50.0), verb=verb)
    assert refused.returncode == 78
    (line,) = refused.stderr.splitlines()
    assert all(part in line for part in ("ids 12 and 9", "50 ppm", "codes_may_overlap"))


def test_who_insists_is_let_pass(tmp_path: Path) -> None:
    passed = check(tmp_path, plate_text(50.0, codes_may_overlap=True))
    assert (passed.returncode, "mistaken" in passed.stderr) == (0, False)


def three(ppm_apart: float, tmp_path: Path, **parts: Any) -> Plate:
    path = tmp_path / "plate.toml"
    path.write_text(plate_text(ppm_apart, **parts))
    return load_plate(str(path))


def test_the_step_that_is_needed_would_do(tmp_path: Path) -> None:
    (found,) = plate_sites.overlaps(three(50.0, tmp_path))
    assert 60.0 < found.needed_ppm < 100.0  # 10 N, then ageing, temperature and noise
    assert found.spacing_ppm == pytest.approx(50.0, rel=1e-3)
    assert plate_sites.overlaps(three(found.needed_ppm + 0.5, tmp_path)) == ()
    assert plate_sites.overlaps(three(found.needed_ppm - 0.5, tmp_path)) != ()


def test_a_wider_span_of_temperatures_needs_more(tmp_path: Path) -> None:
    needed = [
        plate_sites.overlaps(three(50.0, tmp_path, thermal=f"[thermal]\nrange_kelvin = [{low}, {high}]\n"))[
            0
        ].needed_ppm
        for low, high in ((298.0, 298.3), (278.15, 318.15), (298.15, 318.15))
    ]
    # Sites that differ by six standard deviations of 5e-8 per kelvin, 20 K away from 298.15 K at the most.
    assert needed[1] - needed[0] == pytest.approx(6 * 5e-2 * 20.0, rel=0.02)
    assert needed[2] == needed[1]


def test_a_channelised_counter_tells_tones_apart_by_their_number() -> None:
    content = load_plate("comb16").model_dump(mode="json", exclude_none=True)
    for listed in content["sites"]:
        listed["tones"][0]["f0_hz"] = [1e7] * 4
    assert plate_sites.overlaps(Plate.model_validate(content)) == ()
