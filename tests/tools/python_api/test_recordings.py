"""`resonatord.load_recording`: the values that are published, as NumPy arrays and DataFrames."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import resonatord
from export_bench import played, recording
from web_server import served

LIBRARIES = {"scipy", "numpy", "pydantic", "paho", "aiomqtt", "mcap", "pandas"}


def loaded_libraries(folder: Path, code: str) -> set[str]:
    command = (sys.executable, "-c", f"import sys, resonatord\n{code}\nprint(*sys.modules)")
    done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    return LIBRARIES & set(done.stdout.split())


def test_the_import_needs_no_library_and_force_sites_no_scipy(tmp_path: Path) -> None:
    (tmp_path / "resonatord").mkdir()  # as a checkout, in whose parent Python is started
    assert loaded_libraries(tmp_path, "assert resonatord.__version__") == set()
    used = loaded_libraries(tmp_path, f"resonatord.load_recording({str(recording('touches'))!r}).forces")
    assert used == {"numpy", "pydantic", "mcap"}
    assert all(hasattr(resonatord, name) for name in resonatord.__all__)


def test_forces_are_those_that_are_published() -> None:
    forces = resonatord.load_recording(recording("touches")).forces
    messages = played("touches").messages("forces")
    assert forces["t_ns"].tolist() == [message.t_ns for message in messages]
    expected = np.full((len(messages), 16), np.nan)
    for row, message in zip(expected, messages, strict=True):
        for site in message.sites:
            row[site.site - 1] = site.force_newton
    assert np.isfinite(expected).sum() > 20
    for site in range(1, 17):
        np.testing.assert_array_equal(forces[f"site_{site}_force_newton"], expected[:, site - 1])
    assert forces.columns["site_7_systematic_newton"].unit == "N"

    frame = forces.to_pandas()
    np.testing.assert_array_equal(frame["site_7_force_newton"], expected[:, 6])
    assert frame.index.tz is not None
    assert [time.value for time in frame.index] == forces["t_ns"].tolist()
    assert frame.attrs["units"]["site_7_force_newton"] == "N"
    assert set(frame["site_7_status"].dropna()) == {"ok"}


def test_contacts_have_a_row_each_and_missing_counts_are_masked() -> None:
    contacts = resonatord.load_recording(recording("slide")).contacts
    ids = [
        contact.id if contact else None
        for message in played("slide").messages("contacts")
        for contact in message.contacts or (None,)
    ]
    assert None in ids
    assert contacts["contact_id"].tolist() == ids
    numbers = contacts.to_pandas()["contact_id"]
    assert numbers.dtype == "Int64"
    assert numbers.isna().tolist() == [number is None for number in ids]


def test_maps_of_a_skin_are_loaded_where_asked_for() -> None:
    skin = resonatord.load_recording(recording("skin"), topics=["decoded", "signals"])
    messages = played("skin").messages("decoded")
    maps = skin.decoded["traction_pascal"]
    np.testing.assert_array_equal(maps, np.stack([message.traction_pascal for message in messages]))
    assert skin.signals["signals"].shape == (len(played("skin").messages("signals")), 3, 49)
    assert len(skin.decoded.to_pandas()) == len(messages)
    with pytest.raises(resonatord.RecordingError):
        skin.forces  # noqa: B018


def test_a_part_lies_between_marks_or_seconds() -> None:
    whole = resonatord.load_recording(recording("touches"))
    (mark,) = whole.marks
    part = resonatord.load_recording(recording("touches"), start=mark.text, topics="forces")
    assert 0 < part.forces.row_count < whole.forces.row_count
    assert list(part) == ["forces"]
    assert "site_99_force_newton" not in part.forces
    with pytest.raises(resonatord.UserError, match="did you mean site_9_force_newton") as caught:
        part.forces["site_99_force_newton"]
    assert (caught.value.code, isinstance(caught.value, KeyError)) == ("no_column", True)
    empty = resonatord.load_recording(recording("touches"), until=0.01)
    assert empty.contact_events.row_count == 0
    assert len(empty.contact_events.to_pandas()) == 0


def test_a_damaged_recording_is_loaded_up_to_the_damage() -> None:
    with pytest.warns(resonatord.RecordingWarning):
        cut_off = resonatord.load_recording(recording("cut-off"))
    assert cut_off.forces.row_count == len(played("cut-off").messages("forces"))
    assert len(cut_off.problems) == 1


def open_below(folder: Path) -> list[str]:
    """Return what this process has open there, with or without a name."""
    files = Path("/proc/self/fd")
    return [name for file in files.iterdir() if (name := os.path.realpath(file)).startswith(f"{folder}/")]


def test_a_recording_at_a_url_has_the_same_tables_and_its_copy_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    memory = fsspec.filesystem("memory")
    with served(recording("touches").parent) as url:
        for case, source in (("touches", f"{url}recording.mcap"), ("slide", "memory://runs/run.mcap")):
            memory.pipe("/runs/run.mcap", recording(case).read_bytes())
            loaded = resonatord.load_recording(source.replace("http://", "http://user:SECRET@"))
            messages = played(case).messages("contacts/event")
            assert loaded.contact_events["t_ns"].tolist() == [message.t_ns for message in messages] != []
            assert (loaded.path, loaded.problems, open_below(tmp_path)) == (source, (), [])
    memory.pipe("/runs/run.mcap", recording("touches").read_bytes())  # what has changed is copied again
    assert resonatord.load_recording(source).forces.row_count == len(played("touches").messages("forces"))
    for missing in (f"{url}gone.mcap", "memory://nowhere/run.mcap", "nothing://run.mcap"):
        with pytest.raises(resonatord.RecordingError):
            resonatord.load_recording(missing)
        assert open_below(tmp_path) == []
    memory.pipe("/runs/bent.mcap", recording("touches").read_bytes().replace(b"force_max_newton", b"force_mix_newton"))
    with pytest.raises(resonatord.UserError, match=r"^memory://runs/bent"):
        resonatord.load_recording("memory://runs/bent.mcap")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    for unusable, remedy in ((source, "set TMPDIR"), (Path("https://host/run.mcap"), "download the file")):
        with pytest.raises(resonatord.RecordingError, match=remedy):
            resonatord.load_recording(unusable)


@pytest.mark.parametrize("missing", ["fsspec", "s3fs"])
def test_a_url_without_its_library_is_one_message_that_names_it(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(resonatord.UserError, match=f"pip install {missing}$") as caught:
        resonatord.load_recording("s3://bucket/run.mcap")
    assert caught.value.code == "missing_library"


@pytest.mark.parametrize(
    ("path", "arguments", "code"),
    [
        ("nowhere.mcap", {}, "no_recording"),
        (Path(__file__), {}, "no_recording"),
        (recording("touches"), {"topics": ["force"]}, "usage"),
        (recording("touches"), {"start": "no such mark"}, "no_mark"),
        (recording("touches"), {"start": 3, "until": 2}, "no_span"),
        (recording("touches"), {"config": "nowhere.toml"}, "config"),
    ],
)
def test_what_cannot_be_loaded_has_a_code_and_no_cause(path: Any, arguments: dict[str, Any], code: str) -> None:
    with pytest.raises(resonatord.UserError) as caught:
        resonatord.load_recording(path, **arguments)
    assert caught.value.code == code
    assert caught.value.__suppress_context__
    assert "--" not in str(caught.value)
