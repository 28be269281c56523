"""MCAP for viewers: read by the format's own reader, payloads judged by the schemas in the file."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_bench import METADATA, played, points, write
from jsonschema import Draft202012Validator
from mcap.reader import make_reader

from resonator_daemon.board.config.values import plate_text, settings_text
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.tools.replay.recorded_pipeline import Moment


def written(case: str, path: Path, *more: Moment) -> dict[str, list[tuple[Any, Any]]]:
    """Return records and payloads by channel, each payload found as its schema says."""
    write("mcap", path, case, *more)
    found: dict[str, list[tuple[Any, Any]]] = defaultdict(list)
    validators: dict[int, Draft202012Validator] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            if schema.id not in validators:
                Draft202012Validator.check_schema(json.loads(schema.data))
                validators[schema.id] = Draft202012Validator(json.loads(schema.data))
            payload = json.loads(message.data)
            validators[schema.id].validate(payload)
            found[channel.topic].append((message, payload))
        config = played(case).config
        assert [(one.name, one.data.decode()) for one in reader.iter_attachments()] == [
            ("plate.toml", plate_text(config.plate)),
            ("settings.toml", settings_text(config)),
        ]
        assert {one.name: one.metadata for one in reader.iter_metadata()} == {"resonatord": METADATA}
        summary = reader.get_summary()
    assert summary is not None
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"lz4"}
    return found


@pytest.mark.parametrize("case", ["slide", "skin"])
def test_messages_are_those_that_are_published(case: str, tmp_path: Path) -> None:
    found = written(case, tmp_path / "run.mcap")
    paths = {topic.path for moment in played(case).moments for topic, _ in moment.messages}
    for path in paths - {"signals", "decoded"}:
        assert [message.data for message, _ in found[path]] == [encode(one) for one in played(case).messages(path)]
        assert [message.publish_time for message, _ in found[path]] == [one.t_ns for one in played(case).messages(path)]
    infos = (moment for moment in played(case).moments if any(topic.path == "info" for topic, _ in moment.messages))
    times = [moment.now.utc_ns for moment in infos]
    assert [message.log_time for message, _ in found["info"]] == times


def test_forces_are_points_at_the_sites(tmp_path: Path) -> None:
    plate = played("slide").config.plate
    place = dict(zip(plate.site_ids.tolist(), plate.site_positions_m.astype(np.float32).tolist(), strict=True))
    clouds = written("slide", tmp_path / "run.mcap")["forces/cloud"]
    listed = 0
    for (_, cloud), message in zip(clouds, played("slide").messages("forces"), strict=True):
        sec, nsec = divmod(message.t_ns, 10**9)
        assert (cloud["timestamp"], cloud["frame_id"]) == ({"sec": sec, "nsec": nsec}, "left-index")
        origin = dict.fromkeys("xyz", 0.0)
        assert cloud["pose"] == {"position": origin, "orientation": origin | {"w": 1.0}}
        found = points(cloud)
        assert found["site"].tolist() == [force.site for force in message.sites]
        assert [[x, y] for x, y in zip(found["x"], found["y"], strict=True)] == [place[f.site] for f in message.sites]
        for key in ("force_newton", "noise_newton", "systematic_newton", "unobserved_bound_newton"):
            np.testing.assert_array_equal(found[key], [getattr(force, key) for force in message.sites])
        listed += len(message.sites)
    assert listed > 20


def test_maps_and_signals_of_a_skin_are_points(tmp_path: Path) -> None:
    found = written("skin", tmp_path / "run.mcap")
    for (_, cloud), message in zip(found["decoded/cloud"], played("skin").messages("decoded"), strict=True):
        seen = points(cloud)
        for row, axis in enumerate("xyz"):
            np.testing.assert_array_equal(seen[f"traction_{axis}_pascal"], message.traction_pascal[row].ravel())
            np.testing.assert_array_equal(seen[f"traction_std_{axis}_pascal"], message.traction_std_pascal[row].ravel())
    for (_, cloud), message in zip(found["signals/cloud"], played("skin").messages("signals"), strict=True):
        seen = points(cloud)
        np.testing.assert_array_equal(seen["eps_xz"], message.signals[1])
        np.testing.assert_array_equal(seen["eps_yz_std"], message.noise_std[2])
        np.testing.assert_allclose(
            np.stack([seen["x"], seen["y"]], 1), played("skin").config.plate.site_positions_m, rtol=1e-6
        )


def test_states_and_marks_are_lines_of_a_log(tmp_path: Path) -> None:
    mark = Moment(HostTime(0, 1_900_000_000_000_000_007, 0), mark="here\n\ud800")
    found = written("refused", tmp_path / "run.mcap", mark)
    states = played("refused").messages("state/link") + played("refused").messages("state/sensor")
    lines = {(line["name"], line["message"], line["level"]) for _, line in found["log"]}
    levels = {"online": 2, "starting": 2, "refused": 4}
    expected = {(f"{state.state}: {state.reason}", levels.get(state.state, 3)) for state in states}
    assert {(message, level) for _, message, level in lines} == expected
    assert {4, 3} <= {level for _, _, level in lines}
    ((message, line),) = found["marks"]
    assert line["timestamp"] == {"sec": 1_900_000_000, "nsec": 7}
    assert (line["message"], line["name"], message.log_time) == ("here\n\ud800", "mark", 1_900_000_000_000_000_007)
