"""Recordings at URLs: what names them in messages."""

from pathlib import Path

import pytest

from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.recording.reader import open_recording
from resonator_daemon.board.recording.remote import LocalCopy


def test_a_copy_that_cannot_be_opened_is_named_by_its_url(path: Path) -> None:
    with pytest.raises(LinkUnavailableError, match=r"^recording s3://bucket/run\.mcap: [^/]*$"):
        open_recording(LocalCopy(str(path), "s3://bucket/run.mcap"))
