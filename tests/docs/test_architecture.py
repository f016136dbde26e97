"""The rules of layering (CONTRIBUTING.md), checked on the source."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "src"
MODULES = {
    ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((SOURCE / "toolpost").rglob("*.py"))
}
MOST_LINES = 500
TOO_LONG: set[str] = set()
"""Modules that are longer and shall not stay so; the test fails as soon as one is short enough."""


def imports(path: Path) -> set[str]:
    """What a module imports of ours, at its top or anywhere in it, down to the module."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in MODULES else node.module)
    return {name for name in found if name == "toolpost" or name.startswith("toolpost.")}


def within(name: str, part: str) -> bool:
    return name == part or name.startswith(f"{part}.")


def modules_of(part: str) -> list[str]:
    return [name for name in MODULES if within(name, part)]


def assert_only(part: str, allowed: tuple[str, ...]) -> None:
    assert modules_of(part), part
    wrong = {
        (module, name)
        for module in modules_of(part)
        for name in imports(MODULES[module])
        if not any(within(name, other) for other in allowed)
    }
    assert not wrong


def assert_none(part: str, forbidden: tuple[str, ...]) -> None:
    assert modules_of(part), part
    wrong = {
        (module, name)
        for module in modules_of(part)
        for name in imports(MODULES[module])
        if any(within(name, other) for other in forbidden)
    }
    assert not wrong


def test_core_is_pure():
    assert_only("toolpost.core", ("toolpost.core", "toolpost.errors", "toolpost.clock"))


DIALECTS = sorted(
    {".".join(name.split(".")[:3]) for name in modules_of("toolpost.dialects") if name.count(".") > 1}
)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects_only_translate(dialect: str):
    allowed = ("toolpost.core", "toolpost.shop", "toolpost.errors", "toolpost.clock", "toolpost.http")
    allowed = (*allowed, "toolpost.events", "toolpost.gcode", "toolpost.version")
    assert_only(dialect, (*allowed, dialect))


def test_drivers_know_no_http_and_no_shop():
    others = ("toolpost.http", "toolpost.dialects", "toolpost.store", "toolpost.shop", "toolpost.ledger")
    assert_none("toolpost.drivers", (*others, "toolpost.runner", "toolpost.telemetry", "toolpost.app"))


def test_links_know_no_meaning():
    others = ("toolpost.drivers", "toolpost.http", "toolpost.dialects", "toolpost.store", "toolpost.shop")
    assert_none("toolpost.links", (*others, "toolpost.core"))


def test_simulated_machines_know_only_themselves():
    assert_only("toolpost.sim", ("toolpost.sim", "toolpost.errors"))


def test_http_knows_no_dialect():
    others = (
        "toolpost.dialects",
        "toolpost.shop",
        "toolpost.drivers",
        "toolpost.store",
        "toolpost.telemetry",
    )
    assert_none("toolpost.http", others)


def test_store_and_telemetry_know_no_machine():
    others = ("toolpost.dialects", "toolpost.shop", "toolpost.drivers", "toolpost.http", "toolpost.machine")
    assert_none("toolpost.store", (*others, "toolpost.telemetry"))
    assert_none("toolpost.telemetry", (*others, "toolpost.store"))


def test_the_shop_knows_no_http():
    assert_none("toolpost.shop", ("toolpost.http", "toolpost.dialects", "toolpost.app", "toolpost.cli"))


@pytest.mark.parametrize(
    "arguments", [[], ["serve", "--help"], ["sim", "spark", "--help"], ["demo", "--help"]]
)
def test_the_command_line_imports_nothing_heavy(arguments: list[str]):
    code = (
        "import sys\nfrom toolpost.cli import main\n"
        f"if {arguments!r}: main({arguments!r}, standalone_mode=False)\n"
        "print('heavy:', sorted({'starlette', 'uvicorn', 'rich', 'serialx'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True)
    assert run.stdout.splitlines()[-1] == "heavy: []"


@pytest.mark.parametrize("module", MODULES)
def test_modules_are_short(module: str, request: pytest.FixtureRequest):
    if module in TOO_LONG:
        request.applymarker(pytest.mark.xfail(reason="is to be split", strict=True))
    assert len(MODULES[module].read_text("utf-8").splitlines()) <= MOST_LINES


def undocumented(node: ast.Module | ast.ClassDef, where: str) -> list[str]:
    """The public classes and functions in a module or class that have no docstring."""
    found = []
    for child in node.body:
        if not isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if child.name.startswith("_"):
            continue
        name = f"{where}.{child.name}"
        if not ast.get_docstring(child):
            found.append(name)
        if isinstance(child, ast.ClassDef):
            found += undocumented(child, name)
    return found


@pytest.mark.parametrize("module", MODULES)
def test_everything_public_has_a_docstring(module: str):
    tree = ast.parse(MODULES[module].read_text("utf-8"))
    assert ast.get_docstring(tree), module
    is_override = {"toolpost.cli._Commands"}
    assert [name for name in undocumented(tree, module) if name not in is_override] == []
