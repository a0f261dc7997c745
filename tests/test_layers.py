"""A package imports only from packages above it, and a module has one subject."""

import ast
from pathlib import Path

import pytest

import cprl

SOURCE = Path(__file__).parents[1] / "src" / "cprl"
PACKAGES = (
    "libraries",
    "compat",
    "checks",
    "arguments",
    "keys",
    "spaces",
    "custom",
    "output",
    "shipped",
    "caches",
    "compile_clock",
    "times",
    "garbage",
    "process",
    "compiling",
    "memory",
    "institutions",
    "commons",
    "theory",
    "envs",
    "games",
    "preferences",
    "networks",
    "objectives",
    "policies",
    "collectors",
    "learners",
    "algorithms",
    "population",
    "annotations",
    "config",
    "differences",
    "presets",
    "measuring",
    "runs",
    "viewer",
    "terminal",
    "callbacks",
    "finite",
    "training",
    "experiment",
    "stored_agents",
    "stored",
    "earlier",
    "agents",
    "outcome",
    "parts",
    "leftovers",
    "running",
    "studies",
    "evaluation",
    "reporting",
    "flags",
    "commandline",
    "command_parts",
    "evaluation_cli",
    "egta_cli",
    "scenarios_cli",
    "studies_options",
    "studies_cli",
    "exploit_cli",
    "recipes_cli",
    "docs_cli",
    "cli",
    "__main__",
)
MODULES = sorted(path for path in SOURCE.rglob("*.py") if path.parent != SOURCE or path.name != "__init__.py")


def package_of(path):
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def packages_imported(text):
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "cprl":
            parts = node.module.split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
            yield from [parts[1] for parts in names if parts[0] == "cprl" and len(parts) > 1]


def wrong_imports(package, text):
    """What a module of this package imports from below it."""
    return [other for other in packages_imported(text) if PACKAGES.index(other) > PACKAGES.index(package)]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_a_package_imports_only_from_packages_above_it(path):
    assert wrong_imports(package_of(path), path.read_text()) == []


@pytest.mark.parametrize(
    "line", ["from cprl.training import train", "import cprl.viewer.logger", "from cprl import presets"]
)
def test_the_gate_closes(line):
    assert wrong_imports("commons", line)


def test_the_game_knows_nothing_of_torch():
    for path in (SOURCE / "commons").rglob("*.py"):
        imports = [
            name.split(".")[0]
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in (
                [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            )
        ]
        assert not {"torch", "tensordict", "torchrl"} & set(imports), path.name


def test_the_list_of_packages_in_the_docs_is_the_order_that_is_kept():
    listed = [line.split()[0] for line in (cprl.__doc__ or "").splitlines() if line.startswith("    ")]
    assert listed == list(PACKAGES)
    there = {package_of(path) for path in MODULES}
    assert there == set(listed)
