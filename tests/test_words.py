"""The words of the project: short sentences in the docs, and none of the phrases that readers stop at."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
UNCLEAR = re.compile(r"\b(that of the|those of|is none|are none|of others)\b")
"""Phrases that leave open which noun is meant."""
MOST_WORDS = 25
PAGES = sorted(path for path in [ROOT / "README.md", *ROOT.glob("docs/*.md")])


def sentences(page: str) -> list[str]:
    """Return the sentences of a Markdown page without code, tables, headings, pictures and link targets."""
    text = re.sub(r"^```.*?^```", "\n\n", page, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^(?: *(?:\||#|!\[|<)| {4}).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = re.sub(r"`[^`]*`", "code", text)
    paragraphs = re.split(r"\n\s*\n|^ *(?:[-*]|\d+\.) ", text, flags=re.MULTILINE)
    joined = (" ".join(paragraph.split()) for paragraph in paragraphs if paragraph)
    return [sentence for paragraph in joined for sentence in re.split(r"(?<=[.!?:])\s+", paragraph)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_sentences_of_docs_are_short(page):
    long = [sentence for sentence in sentences(page.read_text()) if len(sentence.split()) > MOST_WORDS]
    assert not long


def test_no_phrase_leaves_its_noun_open():
    command = ["git", "ls-files", "-z", "*.py", "*.md", "*.yaml", "Makefile", "viewer/src"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    files = [ROOT / name for name in names if name and name != "tests/test_words.py"]
    lines = [
        f"{file.relative_to(ROOT)}:{number}: {line.strip()}"
        for file in files
        if file.is_file()
        for number, line in enumerate(file.read_text().splitlines(), 1)
        if UNCLEAR.search(line)
    ]
    assert not lines
