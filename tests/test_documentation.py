"""The pages of docs/ and the mentions of them: each link leads somewhere, and the index has each page."""

import ast
import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from resonator_daemon.base.host import text as documentation

ROOT = Path(__file__).parents[1]
FILES = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
PAGES = [ROOT / name for name in FILES if name.endswith(".md") and (ROOT / name).exists()]
PAGE_IN_TEXT = re.compile(r"\bdocs/([\w-]+/[\w-]+\.md)\b")
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


def test_the_way_of_a_frame_names_classes_and_functions_that_there_are() -> None:
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text()
    (section,) = re.findall(r"^## A frame's way through the code\n(.*?)^## ", page, re.MULTILINE | re.DOTALL)
    there: set[str] = set()
    for name in FILES:
        if re.match(r"(resonator_daemon|firmware_protocol)/.*\.py$", name) and (ROOT / name).exists():
            for node in ast.parse((ROOT / name).read_text()).body:
                if isinstance(node, ast.ClassDef | ast.FunctionDef):
                    there.add(node.name)
                if isinstance(node, ast.ClassDef):
                    there |= {f"{node.name}.{part.name}" for part in node.body if isinstance(part, ast.FunctionDef)}
    named = set(re.findall(r"`([^`]+)`", section))
    assert named - there == set()
    assert len(named) > 30
    assert len(section.split()) <= 350


def test_the_page_of_the_command_line_is_that_of_the_parser() -> None:
    page = runpy.run_path(str(ROOT / "docs" / "site" / "command_line.py"))
    assert page["PAGE"].read_text() == page["text"](), "python docs/site/command_line.py writes it"


WORDS_PER_SENTENCE = 32
ABBREVIATION = r"(?<!\beq\.)(?<!\beqs\.)(?<!\bFig\.)(?<!\bProc\.)(?<!\bTrans\.)"


def sentences(page: Path) -> list[tuple[int, str]]:
    """Return line and text of each sentence of a page, without code, tables, headings and comments."""
    text = re.sub(r"^ *```.*?^ *```", lambda code: "\n" * code[0].count("\n"), page.read_text(), flags=re.M | re.S)
    text = re.sub(r"`[^`\n]*`", "code", re.sub(r"\]\([^)]*\)", "]", text))
    found, start, paragraph = [], 0, ""
    for number, line in enumerate([*text.split("\n"), ""], 1):
        item, other = re.match(r" *(?:[-*]|\d+\.) ", line), re.match(r" *(?:$|[|#]|<!--)", line)
        if paragraph and (item or other):
            parts = re.split(ABBREVIATION + r"(?<=[.!?])[)*\"]* +", paragraph)
            found += [(start, part) for part in parts]
            paragraph = ""
        if not other and (paragraph or item or not line.startswith("    ")):
            start = start if paragraph else number
            paragraph += " " + line[item.end() if item else 0 :].strip()
    return found


def test_no_sentence_of_a_page_is_too_long() -> None:
    pages = [page for page in PAGES if ROOT / "docs" in page.parents]
    lengths = [
        (len(re.findall(r"[^\W\d_][\w'-]*", text)), f"{page.relative_to(ROOT)}:{line}", text)
        for page in pages
        for line, text in sentences(page)
    ]
    worst = sorted((row for row in lengths if row[0] > WORDS_PER_SENTENCE), reverse=True)[:10]
    assert worst == [], "\n".join(f"{words} words, {place}: {text}" for words, place, text in worst)


def test_pages_that_hints_name_are_in_the_wheel(tmp_path: Path) -> None:
    for name in FILES:
        if (ROOT / name).is_file() and not name.startswith(("tests/", "benchmarks/")):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tmp_path / name, follow_symlinks=False)
    build = "from setuptools import build_meta; build_meta.build_wheel('dist')"
    subprocess.run([sys.executable, "-c", build], cwd=tmp_path, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        installed = {name.partition("/data/share/doc/resonatord/")[2] for name in content.namelist()}
    sources = "\n".join(source.read_text() for source in (ROOT / "resonator_daemon").rglob("*.py"))
    named = set(re.findall(r"""\bpage\(["']([\w/.-]+)["']\)""", sources)) | set(PAGE_IN_TEXT.findall(sources))
    assert {"how-to/connect.md", "explanation/codes.md"} <= named
    assert named - installed == set()
    assert documentation.page("how-to/connect.md") == str(ROOT / "docs" / "how-to" / "connect.md")
