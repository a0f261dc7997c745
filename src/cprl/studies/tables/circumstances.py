"""Under which versions, code, commit and processor runs were made, and which of them differ from the rest."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from cprl.runs.directory import read_recipe

UNKNOWN: Final = "not recorded"
WORDS: Final = {"git": "git commit", "cpu": "processor"}
_NAMED: Final = 4
"""The largest number of runs that a sentence names."""

Circumstances = Mapping[str, str]
"""The version of each package, the checksum of each module of the user's own, the git commit and the type of
processor, by name. Where a run was resumed under others, all of them in order, with " then " between them."""


def circumstances_of(run: Path) -> Circumstances:
    """What the recipe of a run says of how it was made."""
    recipe = read_recipe(run)
    every = [_of(recipe), *(_of(own) for own in (*recipe.get("extended", ()), *recipe.get("resumed", ())))]
    names = dict.fromkeys(name for own in every for name in own)
    return {name: _joined([own.get(name, UNKNOWN) for own in every]) for name in names}


def marks(made: Mapping[str, Circumstances]) -> dict[str, str]:
    """What of each run's circumstances differs from those of most runs, e.g. "torch, git commit", or "".

    Of circumstances that equally many runs have, the first run's count as those of most.

    Args:
        made: the circumstances by run, in the order of the table.
    """
    usual = {name: _counted(made, name).most_common(1)[0][0] for name in _names(made)}
    return {
        run: ", ".join(
            WORDS.get(name, name) for name, value in usual.items() if own.get(name, UNKNOWN) != value
        )
        for run, own in made.items()
    }


def sentences(made: Mapping[str, Circumstances]) -> list[str]:
    """How the runs of a table were made in different circumstances, a sentence for each."""
    found = []
    for name in _names(made):
        counted = _counted(made, name)
        if len(counted) == 1:
            continue
        parts = []
        for nth, (value, number) in enumerate(counted.most_common()):
            runs = [run for run, own in made.items() if own.get(name, UNKNOWN) == value]
            named = f" ({_some(runs)})" if nth else ""
            parts.append(f"{value} in {number} run{'s' * (number != 1)}{named}")
        found.append(
            f"The runs were made under more than one {WORDS.get(name, f'version of {name}')}: "
            f"{'; '.join(parts)}."
        )
    return found


def _of(recipe: Mapping[str, Any]) -> dict[str, str]:
    found = {name: str(own) for name, own in (recipe.get("versions") or {}).items() if own is not None}
    found |= {module: str(digest)[:12] for module, digest in (recipe.get("code") or {}).items()}
    git = recipe.get("git")
    if isinstance(git, Mapping):
        found["git"] = f"{str(git.get('commit'))[:12]}{' with changes' if git.get('dirty') else ''}"
    if recipe.get("cpu"):
        found["cpu"] = str(recipe["cpu"])
    return found


def _joined(values: list[str]) -> str:
    """Values in order, without one that follows itself."""
    return " then ".join(own for nth, own in enumerate(values) if not nth or own != values[nth - 1])


def _names(made: Mapping[str, Circumstances]) -> list[str]:
    return list(dict.fromkeys(name for own in made.values() for name in own))


def _counted(made: Mapping[str, Circumstances], name: str) -> Counter[str]:
    return Counter(own.get(name, UNKNOWN) for own in made.values())


def _some(runs: list[str]) -> str:
    more = f" and {len(runs) - _NAMED} more" if len(runs) > _NAMED else ""
    return f"{', '.join(runs[:_NAMED])}{more}"
