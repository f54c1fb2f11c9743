"""The code blocks of README and docs/, and what their comments say of them.

A block without a comment before it is run. The comments, each on a line of its own:

``<!-- not run: REASON -->``    what cannot run in a test, and why
``<!-- slow -->``               takes more than a few seconds; ``<!-- docs-test: slow -->`` at the top: all of a page
``<!-- docs-test: by FILE -->`` at the top: a test of its own runs the page
``<!-- after: COMMAND -->``     what has to be run before
``<!-- exit: CODE -->``         the exit code that is expected
``<!-- output: TEXT -->``       of a text block: it is what the shell block before it prints, but for times
"""

import re
import textwrap
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
_MARKS = r"(?P<marks>(?:^ *<!--[^\n]*-->\n\s*)*)"
_BLOCK = re.compile(_MARKS + r"^ *```(?P<lang>\w*)[^\n]*\n(?P<text>.*?)^ *```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A fenced block: where it is, its language, its text, and the comments before it."""

    page: Path
    line: int
    language: str
    text: str
    marks: dict

    @property
    def run(self):
        return self.language in ("sh", "python") and "not run" not in self.marks

    @property
    def slow(self):
        return "slow" in self.marks


def blocks(page):
    """All blocks of a page, in order."""
    content = page.read_text(encoding="utf-8")
    whole_page = "<!-- docs-test: slow -->" in content
    elsewhere = re.search("<!-- docs-test: by (.*?) -->", content)
    for match in _BLOCK.finditer(content):
        marks = dict(re.findall(r"<!-- ([a-z ]+?)(?:: (.*?))? -->", match["marks"]))
        if whole_page:
            marks["slow"] = ""
        if elsewhere is not None:
            assert page.name in (ROOT / elsewhere[1]).read_text(encoding="utf-8"), f"{elsewhere[1]} runs no {page.name}"
            marks["not run"] = f"run by the test {elsewhere[1]}"
        line = content[: match.start("lang")].count("\n") + 1
        yield Block(page, line, match["lang"], textwrap.dedent(match["text"]), marks)
