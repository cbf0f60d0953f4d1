"""The laws of the layout, kept by tests. Each law is also broken on purpose, to show that its test can fail."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path

import pytest

from semrecon.data import Optics, TiltSeries, View

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("semsim", "semrecon", "benchmarks")
FILES = sorted(path.relative_to(ROOT) for package in PACKAGES for path in (ROOT / package).rglob("*.py"))

STRANGERS = {"semsim": {"semrecon", "benchmarks", "tests"}, "semrecon": {"semsim", "benchmarks", "tests"}}
"""What a package must not import, not even inside a function."""

COMMAND_LINES = {
    "semsim/cli.py",
    "semrecon/cli.py",
    "semrecon/console.py",
    "semrecon/commands/",
    "benchmarks/__main__.py",
    "benchmarks/console.py",
    "benchmarks/commands/",
}
"""What talks to people; a name that ends with a slash is all files of a folder."""

ONLY_IN = {
    "matplotlib": {
        "semsim/figures.py",
        "semrecon/output/figures.py",
        "semrecon/output/maps.py",
        "semrecon/output/charts.py",
        "semrecon/agreement/comparison_figure.py",
        "benchmarks/seed_study/figures.py",
        "benchmarks/reporting/error_figures.py",
        "benchmarks/sweeping/sweep_figures.py",
    },
    "plotly": {"benchmarks/reporting/report_figures.py"},
    "rerun": {"semrecon/output/recording.py", "benchmarks/recording/rerun_file.py"},
    "typer": COMMAND_LINES,
    "rich": COMMAND_LINES,
}
"""The files that may import a library which the numbers must not depend on."""

SLOW = {"open3d", "rerun", "plotly", "pyrender", "OpenGL", "matplotlib"}
"""Libraries to be imported by the function that needs them, so that `--help` answers in a blink."""

LONGEST = 400
PROJECT_OF_MODULE = {"cv2": "opencv-python-headless", "PIL": "pillow", "skimage": "scikit-image", "rerun": "rerun-sdk"}

Law = Callable[[str, str], list[str]]
"""A law takes a file's path and its source, and answers what breaks it."""


def imported(node: ast.AST) -> list[str]:
    """Return the modules that a node imports; a relative import stays in its package and is none."""
    match node:
        case ast.Import():
            return [alias.name for alias in node.names]
        case ast.ImportFrom(level=0):
            return [str(node.module)]
        case ast.Call(func=ast.Name(id="__import__") | ast.Attribute(attr="import_module"), args=[ast.Constant(name)]):
            return [str(name)]
    return []


def imports(nodes: Iterator[ast.AST]) -> set[str]:
    return {name.partition(".")[0] for node in nodes for name in imported(node)}


def at_import_time(node: ast.AST) -> Iterator[ast.AST]:
    """Walk what runs when a module is imported: not the bodies of functions, not what only a type checker reads."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        yield child
        yield from at_import_time(child)


def keeps_apart(path: str, source: str) -> list[str]:
    strangers = STRANGERS.get(path.partition("/")[0], set())
    return sorted(imports(ast.walk(ast.parse(source))) & strangers)


def is_among(path: str, places: set[str]) -> bool:
    return path in places or any(path.startswith(place) for place in places if place.endswith("/"))


def keeps_pictures_out(path: str, source: str) -> list[str]:
    found = imports(ast.walk(ast.parse(source)))
    return sorted(name for name in found if name in ONLY_IN and not is_among(path, ONLY_IN[name]))


def imports_slow_libraries_late(path: str, source: str) -> list[str]:
    return sorted(imports(at_import_time(ast.parse(source))) & SLOW)


def is_short(path: str, source: str) -> list[str]:
    lines = len(source.splitlines())
    return [f"{lines} lines"] if lines > LONGEST else []


def is_named_by_a_noun(path: str, source: str) -> list[str]:
    return [path] if re.search(r"(^|/|_)(utils?|helpers?|misc|common)\.py$", path) else []


def explains_what_is_public(path: str, source: str) -> list[str]:
    if "/test_" in path:  # the name of a test is its claim
        return []
    module = ast.parse(source)
    named = [node for node in module.body if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name[0] != "_"]
    return [getattr(node, "name", "the file") for node in [module, *named] if ast.get_docstring(node) is None]


def declares_what_it_imports(path: str, source: str) -> list[str]:
    if path.startswith("benchmarks/"):
        return []
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [line for lines in project.get("optional-dependencies", {}).values() for line in lines]
    declared = {re.split(r"[<>=!~\[; ]", line)[0].lower() for line in project["dependencies"] + extras}
    found = imports(ast.walk(ast.parse(source))) - sys.stdlib_module_names - set(PACKAGES)
    return sorted(found - {name for name in found if PROJECT_OF_MODULE.get(name, name).replace("_", "-") in declared})


BROKEN: list[tuple[Law, str, str]] = [
    (keeps_apart, "semrecon/a.py", "import semsim.microscope"),
    (keeps_apart, "semsim/a.py", "def f():\n    from semrecon.geometry import project"),
    (keeps_apart, "semrecon/methods/a.py", "def f():\n    import benchmarks.adapt"),
    (keeps_apart, "semsim/a.py", "import importlib\nx = importlib.import_module('semrecon.data')"),
    (keeps_pictures_out, "semrecon/matches/matching.py", "def f():\n    from matplotlib import pyplot"),
    (keeps_pictures_out, "semrecon/methods/cli.py", "import typer"),
    (keeps_pictures_out, "benchmarks/running/runner.py", "def f():\n    import rerun as rr"),
    (imports_slow_libraries_late, "semsim/a.py", "import open3d.t.geometry"),
    (
        imports_slow_libraries_late,
        "semsim/a.py",
        "class A:\n    try:\n        import rerun\n    except OSError: pass",
    ),
    (is_short, "semsim/a.py", "x = 1\n" * (LONGEST + 1)),
    (is_named_by_a_noun, "semrecon/utils.py", ""),
    (explains_what_is_public, "semsim/a.py", '"""A file."""\ndef f(): pass'),
    (explains_what_is_public, "semsim/a.py", "x = 1"),
    (declares_what_it_imports, "semsim/a.py", "def f():\n    import pandas"),
]
KEPT: list[tuple[Law, str, str]] = [
    (keeps_apart, "semsim/a.py", "from . import semrecon\nimport semsim.microscope"),
    (keeps_apart, "benchmarks/adapt.py", "import semsim, semrecon"),
    (imports_slow_libraries_late, "semsim/a.py", "def f():\n    import open3d"),
    (imports_slow_libraries_late, "semsim/a.py", "if TYPE_CHECKING:\n    import open3d"),
    (is_short, "semsim/a.py", "x = 1\n" * LONGEST),
    (declares_what_it_imports, "semsim/a.py", "import json, cv2, tomli_w\nfrom semsim.mesh import Mesh"),
]
LAWS = sorted({law for law, _, _ in BROKEN}, key=lambda law: law.__name__)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
def test_every_file_keeps_the_law(law: Law) -> None:
    broken = {str(path): law(path.as_posix(), (ROOT / path).read_text(encoding="utf-8")) for path in FILES}
    assert {path: faults for path, faults in broken.items() if faults} == {}


@pytest.mark.parametrize(("law", "path", "source"), BROKEN)
def test_a_broken_law_is_noticed(law: Law, path: str, source: str) -> None:
    assert law(path, source)


@pytest.mark.parametrize(("law", "path", "source"), KEPT)
def test_a_kept_law_is_not_blamed(law: Law, path: str, source: str) -> None:
    assert not law(path, source)


@pytest.mark.parametrize("package", ["semsim", "semrecon"])
def test_importing_a_whole_package_loads_nothing_slow(package: str) -> None:
    """Also what comes in by way of others: every module of the package, in a process of its own."""
    code = (
        f"import importlib, pkgutil, sys, {package} as top\n"
        "for found in pkgutil.walk_packages(top.__path__, top.__name__ + '.'): importlib.import_module(found.name)\n"
        f"print(*sorted(set(sys.modules) & {SLOW!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert (done.stdout.split(), done.stderr) == ([], "")


def test_the_packages_were_found() -> None:
    assert {path.parts[0] for path in FILES} == set(PACKAGES)


def test_a_series_has_no_field_that_could_hold_truth() -> None:
    """A new field here is a decision: can it carry depth, visibility or true poses to a method?"""
    assert {f.name for f in fields(TiltSeries)} == {"views", "optics", "tilt_axis_deg", "channel_geometry"}
    assert {f.name for f in fields(View)} == {"image", "tilt_deg", "name", "mask", "channels", "stage_um"}
    assert {f.name for f in fields(Optics)} == {"pixel_size_um", "width_px", "height_px", "inverse_working_distance"}
