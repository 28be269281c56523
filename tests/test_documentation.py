"""The pages of docs/ and the mentions of them: each link leads somewhere, and the index has each page."""

import re
import runpy
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
PAGES = [ROOT / name for name in FILES if name.endswith(".md") and (ROOT / name).exists()]
MENTION = re.compile(rb"\bdocs/[\w/.-]+\.(?:md|svg|py|toml)\b")


def prose(page: Path) -> str:
    """Return a page without its blocks of code."""
    return re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MkDocs make them."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page: Path) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        name, _, anchor = target.partition("#")
        file = (page.parent / name) if name else page
        if "://" in target or (file.exists() and (not anchor or anchor in anchors(file))):
            continue
        broken.append(target)
    assert broken == []


def test_mentions_in_code_and_text_name_files() -> None:
    contents = {name: (ROOT / name).read_bytes() for name in FILES if (ROOT / name).is_file()}
    mentions = {(name, mention.decode()) for name, content in contents.items() for mention in MENTION.findall(content)}
    assert [(name, mention) for name, mention in sorted(mentions) if not (ROOT / mention).exists()] == []


def test_every_page_is_in_the_index() -> None:
    folder = ROOT / "docs"
    linked = {(folder / target).resolve() for target in re.findall(r"\]\(([^)#]+)", (folder / "README.md").read_text())}
    pages = {page for page in PAGES if folder in page.parents and page.name != "README.md"}
    assert {str(page.relative_to(ROOT)) for page in pages - linked} == set()


def test_the_page_of_the_command_line_is_that_of_the_parser() -> None:
    page = runpy.run_path(str(ROOT / "docs" / "site" / "command_line.py"))
    assert page["PAGE"].read_text() == page["text"](), "python docs/site/command_line.py writes it"
