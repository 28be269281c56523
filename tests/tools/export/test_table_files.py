"""CSV and Parquet have the very values that are published, read back by programs that others wrote."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from export_bench import Played, played, write

from resonator_daemon.mqtt.payload_types import NO_UNIT, unit_of
from resonator_daemon.mqtt.payloads import Contact, Contacts, Health
from resonator_daemon.tools.export.output import TableOutput
from resonator_daemon.tools.export.tables import sources

OF_SITE = ("force_newton", "noise_newton", "systematic_newton", "unobserved_bound_newton")


@pytest.fixture(autouse=True)
def many_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TableOutput, "batch_bytes", 40_000)


def same(one: Any, other: Any) -> bool:
    """Compare two values; NaN is equal to NaN and to nothing else."""
    return bool(one == other or (one != one and other != other))


def parquet(case: str, folder: Path) -> tuple[Played, dict[str, Any]]:
    output = write("parquet", folder / "out.parquet", case)
    read = {path: folder / f"out-{path.replace('/', '-')}.parquet" for path in output.rows}
    return played(case), {path: pq.read_table(file) for path, file in read.items()}


@pytest.mark.parametrize("case", ["touches", "comb", "slide"])
def test_forces_in_parquet_are_those_that_are_published(case: str, tmp_path: Path) -> None:
    played_case, tables = parquet(case, tmp_path)
    messages, rows = played_case.messages("forces"), tables["forces"].to_pylist()
    assert len(rows) == len(messages)
    touched = 0
    for message, row in zip(messages, rows, strict=True):
        assert (row["t_ns"], row["t_uncertainty_ns"], row["seq"]) == (
            message.t_ns,
            message.t_uncertainty_ns,
            message.seq,
        )
        assert (row["board_ticks"], row["window_s"]) == (message.board_ticks, message.window_s)
        assert (row["status"], row["reason"]) == (message.status, message.reason)
        assert [n for n in range(4) if row[f"channel_{n}_beats"]] == sorted(message.beats or ())
        listed = {force.site: force for force in message.sites}
        touched += len(listed)
        for site in map(int, played_case.config.plate.site_ids):
            for key in (*OF_SITE, "status", "at_least_newton"):
                value = row[f"site_{site}_{key}"]
                assert same(value, getattr(listed[site], key)) if site in listed else value is None
    assert touched > 20
    compensated = 0
    for state, row in zip(played_case.messages("state/sensor"), tables["state/sensor"].to_pylist(), strict=True):
        applied = state.compensation
        assert row["compensation_baseline"] == (applied.baseline if applied else None)
        for channel, common_mode in enumerate(applied.common_mode if applied else ()):
            assert same(row[f"compensation_channel_{channel}_common_mode"], common_mode)
            assert same(row["compensation_plate_kelvin"], applied.plate_kelvin)
            compensated += 1
    assert compensated > 4
    assert not tables["forces"].schema.field("channel_0_beats").nullable
    assert pq.ParquetFile(tmp_path / "out-forces.parquet").num_row_groups > 1


@pytest.mark.parametrize("case", ["comb", "slide", "skin"])
def test_contacts_have_a_row_each_and_messages_without_any_have_one(case: str, tmp_path: Path) -> None:
    played_case, tables = parquet(case, tmp_path)
    rows = iter(tables["contacts"].to_pylist())
    for message in played_case.messages("contacts"):
        for contact in message.contacts:
            row = next(rows)
            assert (row["seq"], row["status"], row["contact_status"]) == (message.seq, message.status, contact.status)
            assert (row["contact_id"], row["contact_site"]) == (contact.id, contact.site)
            assert (row["contact_position_x_m"], row["contact_position_y_m"]) == contact.position_m
            assert row["contact_position_covariance_yy_m2"] == contact.position_covariance_m2[2]
            assert same(row["contact_force_z_newton"], contact.force_newton[2])
            for key in ("slip_margin", "at_least_newton"):
                assert same(row[f"contact_{key}"], getattr(contact, key))
        if not message.contacts:
            row = next(rows)
            assert (row["seq"], row["contact_id"], row["contact_force_z_newton"]) == (message.seq, None, None)
    assert next(rows, None) is None
    events = tables["contacts/event"].to_pylist()
    published = played_case.messages("contacts/event")
    assert [(row["event"], row["contact_peak_newton"]) for row in events] == [
        (event.event, event.contact.peak_newton) for event in published
    ]


def test_maps_of_a_skin_in_parquet(tmp_path: Path) -> None:
    played_case, tables = parquet("skin", tmp_path)
    for path, key in (("decoded", "traction_pascal"), ("signals", "noise_std"), ("decoded", "traction_std_pascal")):
        field = tables[path].schema.field(key)
        shape = json.loads(field.metadata[b"shape"])
        read = np.array(tables[path][key].to_pylist(), np.float32).reshape(-1, *shape)
        np.testing.assert_array_equal(read, np.stack([getattr(m, key) for m in played_case.messages(path)]))
    field = tables["decoded"].schema.field("traction_pascal")
    assert (field.nullable, field.metadata[b"unit"]) == (True, b"Pa")
    assert tables["decoded"]["grid_origin_x_m"][0].as_py() == played_case.messages("decoded")[0].grid.origin_m[0]
    rows = iter(tables["decoded/summary"].to_pylist())
    for message in played_case.messages("decoded/summary"):
        for patch in message.patches:
            row = next(rows)
            assert (row["border_contact"], row["patch_id"]) == (message.border_contact, patch.id)
            assert same(row["patch_stick_ratio"], patch.stick_ratio)
        if not message.patches:
            assert next(rows)["patch_area_m2"] is None


@pytest.mark.parametrize("case", ["touches", "skin"])
def test_every_number_has_its_unit_in_its_name(case: str, tmp_path: Path) -> None:
    _, tables = parquet(case, tmp_path)
    for table in tables.values():
        assert table.schema.metadata.items() >= {b"plate": b"quartz16", b"source_sha256": b"00ff"}.items()
        for field in table.schema:
            unit = field.metadata.get(b"unit", b"").decode()
            if unit not in ("", NO_UNIT):
                assert unit_of(field.name) == unit, field.name
            assert unit or str(field.type) not in ("double", "uint64"), field.name
            assert str(field.type) != "string" or not unit
            assert field.metadata[b"description"], field.name


@pytest.mark.parametrize("case", ["slide", "comb"])
def test_csv_has_what_parquet_has(case: str, tmp_path: Path) -> None:
    played_case, tables = parquet(case, tmp_path)
    output = write("csv", tmp_path / "out.csv", case)
    for path in output.rows:
        table = tables[path]
        with (tmp_path / f"out-{path.replace('/', '-')}.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == table.num_rows
        for row, values in zip(rows, table.to_pylist(), strict=True):
            for name, value in values.items():
                text = row[name]
                if value is None:
                    assert text == ""
                elif isinstance(value, bool):
                    assert text == ("true" if value else "false")
                else:
                    assert same(type(value)(text), value)
    assert any("nan" in row for row in (tmp_path / "out-contacts.csv").read_text().splitlines())
    at = [tables["forces"].schema.names.index(name) for name in ("t_ns", "board_ticks")]
    read = np.loadtxt(tmp_path / "out-forces.csv", np.uint64, delimiter=",", quotechar='"', skiprows=1, usecols=at)
    assert read.tolist() == [[message.t_ns, message.board_ticks] for message in played_case.messages("forces")]


def test_what_has_no_fixed_length_is_no_column() -> None:
    with pytest.raises(ValueError, match=r"contacts is tuple.*, which is no column"):
        list(sources(Contacts))
    with pytest.raises(ValueError, match=r"records_unusable is dict"):
        list(sources(Health))


def test_the_components_of_a_vector_that_is_missing_are_missing() -> None:
    get = {source.column.name: source.get for source in sources(Contact)}
    assert get["moment_y_newton_m"](Contact.model_construct(moment_newton_m=None)) is None
