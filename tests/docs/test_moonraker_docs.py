"""The page on Moonraker's API names every method, with its verb and path, and no other."""

import re
from pathlib import Path
from unittest.mock import MagicMock

from toolpost.dialects.moonraker.app import Moonraker
from toolpost.events import Events

ROW = re.compile(r"^\| `([a-z_.]+\.[a-z_]+)` \| (.*?) \|", re.MULTILINE)
PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "moonraker-api.md").read_text("utf-8")


def test_methods_are_documented():
    moonraker = Moonraker(MagicMock(), "edm", Events())
    there = {
        method.name: ", ".join(f"`{verb} {path}`" for verb, path in method.http_pairs) or "-"
        for method in moonraker._methods
    }
    assert dict(ROW.findall(PAGE)) == there


def test_notifications_are_documented(request):
    sources = (request.config.rootpath / "src/toolpost/dialects/moonraker").glob("*.py")
    sent = {name for path in sources for name in re.findall(r'"(notify_[a-z_]+)"', path.read_text("utf-8"))}
    assert sent
    assert sent == set(re.findall(r"`(notify_[a-z_]+)`", PAGE))
