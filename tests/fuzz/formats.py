"""The files of a run, damaged: each is read as it was, or refused; nothing else comes of it."""

import shutil
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import strategies as st

import cprl
from cprl.experiment import Experiment
from cprl.reporting.result import read_result
from cprl.runs.directory import read_recipe
from cprl.runs.episodes import read_episodes
from cprl.runs.export import export_results

from . import cases, damage, runs
from .cases import Case, Target


def _renamed(run: Path, path: Path) -> None:
    """Gives a damaged checkpoint the name that its content asks for, as somebody who forges one would."""
    if path.is_file() and path.stat().st_size < 1 << 24:
        digest = blake2b(path.read_bytes(), digest_size=16).hexdigest()
        path.rename(path.with_name(f"{path.name[:21]}-{digest}.pt"))


def _networks(run: Path) -> Any:
    loaded = cprl.load(run, allow=runs.ALLOW)
    return {
        name: {key: own.tolist() for key, own in network.state_dict().items()}
        for name, network in loaded.networks.items()
    }, repr(loaded.transforms_state)


def _resumed(run: Path) -> Any:
    experiment = Experiment.from_recipe(read_recipe(run), allow=runs.ALLOW, directory=run)
    with runs.stopped_after(2):
        try:
            cprl.run(experiment, run, resume=True, watch="off")
        except runs.Stopped:
            return "resumed"
    return "resumed"


def _extended(run: Path) -> Any:
    experiment = Experiment.from_recipe(read_recipe(run), allow=runs.ALLOW, directory=run)
    with runs.stopped_after(2):
        try:
            cprl.run(replace(experiment, episodes=4), run, resume=True, watch="off")
        except runs.Stopped:
            return "extended"
    return "extended"


def _experiment(run: Path) -> Any:
    recipe = read_recipe(run)
    return recipe, Experiment.from_recipe(recipe, allow=runs.ALLOW, directory=run)


def _says_the_same(before: Any, now: Any) -> bool:
    """An experiment says what its recipe says; it may have been edited, so that it need not be the same."""
    recipe, experiment = now
    return "experiment" not in recipe or _within(recipe["experiment"], experiment.to_config())


def _within(part: Any, whole: Any) -> bool:
    if isinstance(part, dict) and isinstance(whole, dict):
        return all(name in whole and _within(own, whole[name]) for name, own in part.items())
    if isinstance(part, list) and isinstance(whole, list):
        return len(part) == len(whole) and all(map(_within, part, whole))
    return bool(part == whole) and isinstance(part, bool) == isinstance(whole, bool)


def _is_beginning(before: pa.Table, now: pa.Table) -> bool:
    """A journal that lost its end keeps its beginning."""
    return len(now) <= len(before) and before.slice(0, len(now)).equals(now)


def _exported(run: Path) -> Any:
    export_results(run, run / "exported")
    tables = sorted((run / "exported").rglob("*.parquet"))
    return [(own.name, pq.read_table(own).to_pydict()) for own in tables]


def _same(before: Any, now: Any) -> bool:
    return repr(before) == repr(now)


def _any(before: Any, now: Any) -> bool:
    return True


_DAMAGES: Final = {
    ".json": lambda: st.one_of(damage.of_bytes(), damage.of_json(), damage.of_json()),
    ".pt": lambda: st.one_of(damage.of_bytes(), damage.of_weights()),
    ".parquet": lambda: st.one_of(damage.of_bytes(), damage.of_table()),
    ".arrows": lambda: st.one_of(damage.of_bytes(), damage.of_table()),
    ".csv": damage.of_bytes,
    ".lock": lambda: st.one_of(damage.of_bytes(), damage.of_json()),
}

_FORMATS: Final = (
    ("recipe.json", "finished", "recipe.json", _experiment, _says_the_same),
    ("recipe.json of results", "results", "recipe.json", _networks, _any),
    ("recipe.json, resumed", "stopped", "recipe.json", _resumed, _any),
    ("final.pt", "finished", "checkpoints/final.pt", _networks, _same),
    ("final.pt of results", "results", "checkpoints/final.pt", _networks, _same),
    ("transforms.pt", "finished", "checkpoints/transforms.pt", _networks, _same),
    ("episodes.parquet", "finished", "episodes.parquet", read_episodes, _is_beginning),
    ("episodes.parquet, reported", "plain", "episodes.parquet", read_result, _any),
    ("episodes.arrows", "stopped", "episodes.arrows", read_episodes, _is_beginning),
    ("episodes.arrows, resumed", "stopped", "episodes.arrows", _resumed, _any),
    ("evaluation/trained.parquet", "finished", "evaluation/trained.parquet", _exported, _same),
    ("report.json", "plain", "report.json", read_result, _any),
    ("training-*.pt", "stopped", "checkpoints/training-*.pt", _networks, None),
    ("training-*.pt, resumed", "stopped", "checkpoints/training-*.pt", _resumed, _any),
    ("logs/*.csv, resumed", "stopped", "logs/csv/scalars/**/*.csv", _resumed, _any),
    ("manifest.json", "finished", "manifest.json", _networks, _same),
    ("run.lock, resumed", "stopped", "run.lock", _resumed, _any),
    ("ending-*.pt, extended", "finished", "checkpoints/ending-*.pt", _extended, _any),
)
"""Each format: its name, a run that has it, its path there, who reads it, whether what was read is right."""


_LOCK: Final = '{"host": "elsewhere", "pid": 1, "started": "2026-11-01T10:00:00+00:00"}'
"""What a process of another host left behind."""


def targets() -> list[Target]:
    """A target for each format of a file."""
    return [_target(*own) for own in _FORMATS]


def _target(name: str, run: str, path: str, read: Any, is_right: Any) -> Target:
    suffix = Path(path).suffix
    drawn = st.fixed_dictionaries(
        {"damage": _DAMAGES[suffix](), "which": st.integers(0, 5), "forged": st.booleans()}
    )

    def call(case: Case) -> Any:
        place = runs.copied(run)
        if path == "run.lock" and not (place / path).exists():
            (place / path).write_text(_LOCK)
        found = sorted(place.glob(path))
        chosen = found[case.arguments["which"] % len(found)]
        damage.apply(chosen, case.arguments["damage"])
        if chosen.name.startswith("training-") and case.arguments["forged"]:
            _renamed(place, chosen)
        return read(place)

    def after(case: Case, result: Any) -> str | None:
        if is_right is None:
            return None
        before = _undamaged(read, run)
        return None if is_right(before, result) else f"was read as something else: {result!r:.200}"

    return Target(
        name=f"file:{name}",
        kind=cases.FILE,
        cases=drawn.map(Case),
        call=call,
        refusals=(ValueError, MemoryError, OSError),
        after=after,
        in_folder=True,
        weight=1 if read is not _resumed else 0,
    )


_READ: dict[Any, Any] = {}


def _undamaged(read: Any, run: str) -> Any:
    key = read, run
    if key not in _READ:
        place = runs.copied(run)
        _READ[key] = read(place)
        shutil.rmtree(place)
    return _READ[key]
