"""A package imports only from packages above it, in the order that the docstring of cprl lists."""

import ast
from pathlib import Path

import pytest

import cprl

SOURCE = Path(cprl.__file__).parent
PACKAGES = [line.split()[0] for line in (cprl.__doc__ or "").splitlines() if line.startswith("    ")]


def modules_imported(text):
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module == "cprl":
            yield from (f"cprl.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def imports_from_below(package, text):
    names = [name.split(".") for name in modules_imported(text)]
    imported = {name[1] for name in names if name[0] == "cprl" and len(name) > 1}
    return sorted(other for other in imported if PACKAGES.index(other) > PACKAGES.index(package))


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imports_only_from_packages_above_it(package):
    files = [*(SOURCE / package).rglob("*.py"), *SOURCE.glob(f"{package}.py")]
    assert files
    assert {
        file.name: below for file in files if (below := imports_from_below(package, file.read_text()))
    } == {}


def test_every_package_is_in_the_list():
    entries = {
        path.stem for path in SOURCE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert entries - {"__init__", "__main__"} == set(PACKAGES)


@pytest.mark.parametrize(
    "line", ["from cprl.training import train", "import cprl.viewer.logger", "from cprl import population"]
)
def test_an_import_from_below_is_noticed(line):
    assert imports_from_below("commons", line)


def test_the_game_knows_nothing_of_torch():
    for path in (SOURCE / "commons").rglob("*.py"):
        roots = {name.split(".")[0] for name in modules_imported(path.read_text())}
        assert not {"torch", "tensordict", "torchrl"} & roots, path.name
