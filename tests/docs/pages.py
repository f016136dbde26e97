"""Reading the project's Markdown: headings, tables, code blocks and links."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
)

_FENCE = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"`([^`\n]+)`")


class Block(NamedTuple):
    """A fenced block of code."""

    page: Path
    info: str
    text: str


def name(page: Path) -> str:
    """The name of a page in messages."""
    return str(page.relative_to(ROOT))


def blocks(kind: str, pages: list[Path] = PAGES) -> list[Block]:
    """The code blocks whose info string begins with `kind`."""
    found = [
        Block(page, match["info"], match["text"])
        for page in pages
        for match in _FENCE.finditer(page.read_text("utf-8"))
    ]
    return [block for block in found if block.info.split(" ")[0] == kind]


def prose(page: Path) -> str:
    """A page without its code blocks."""
    return _FENCE.sub("", page.read_text("utf-8"))


def words_in_code(text: str) -> list[str]:
    """What stands between backticks."""
    return _CODE.findall(text)


def sections(page: Path) -> dict[str, str]:
    """The text under each heading of a page, up to the next heading of any level."""
    parts = re.split(r"^#+ (.+)$", page.read_text("utf-8"), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def rows(text: str) -> Iterator[list[str]]:
    """The cells of each row of the tables in a text, without heads and rules."""
    lines = text.splitlines()
    for above, line in zip(["", *lines], lines, strict=False):
        is_head = above.strip() == "" or not above.startswith("|")
        if line.startswith("|") and not is_head and not re.fullmatch(r"[|:\- ]+", line):
            yield [cell.strip() for cell in line.strip().strip("|").split("|")]


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub makes of a page's headings."""
    found = set()
    for heading in sections(page):
        text = re.sub(r"[^\w\- ]", "", heading.lower())
        found.add(text.strip().replace(" ", "-"))
    return found
