"""Recordings at URLs: what names them in messages."""

from pathlib import Path

import pytest

from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.recording.reader import open_recording
from resonator_daemon.board.recording.remote import LocalCopy, without_secrets


def test_user_information_query_and_fragment_of_urls_are_removed() -> None:
    url, public = "https://user:p@ss@host:84/a@b.mcap?Signature=s/@x#part", "https://host:84/a@b.mcap"
    assert without_secrets(url) == public
    assert without_secrets(f"zip://run.mcap::{url}") == f"zip://run.mcap::{public}"
    assert without_secrets(f"403, message='Forbidden', url='{url}'") == f"403, message='Forbidden', url='{public}"
    assert without_secrets("runs/run?.mcap") == "runs/run?.mcap"
    assert without_secrets("s3://b/run-?.mcap?X-Amz-Signature=s") == "s3://b/run-?.mcap"
    assert without_secrets("https://host/run.mcap?SECRET") == "https://host/run.mcap"


def test_a_copy_that_cannot_be_opened_is_named_by_its_url(path: Path) -> None:
    with pytest.raises(LinkUnavailableError, match=r"^recording s3://bucket/run\.mcap: [^/]*$"):
        open_recording(LocalCopy(str(path), "s3://bucket/run.mcap"))
