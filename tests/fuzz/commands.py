"""Command lines, called in this process: what they start stops after two steps and opens no viewer; whoever
plays types a few keys in the terminal."""

import contextlib
import io
import sys
from collections.abc import Callable, Iterator
from typing import Any, Final
from unittest import mock

from hypothesis import strategies as st

from cprl import cli, presets

from . import cases, hostile, public, runs
from .cases import Case, Target

RECIPES: Final = sorted(path.stem for path in (public.ROOT / "recipes").glob("*.py"))

_NUMBERS: Final = [own for own in hostile.LIMITS if not 100 < own < 10_000]
"""Without those that ask for much work and nothing else."""

_WORDS: Final = st.one_of(
    st.sampled_from(
        [own for own in hostile.TEXTS if "\0" not in own and "\ud800" not in own and "\udfff" not in own]
    ),
    st.sampled_from((*map(str, _NUMBERS), "nan", "inf", "-inf", "1e400", "0.5", "1_000", "٣", "\udc80x")),
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8),
).map(lambda word: word.lstrip("/"))
"""Words that a shell can hand over; none leads out of the working directory by a slash in front."""


def _flag(name: str, *values: str) -> st.SearchStrategy[list[str]]:
    """A flag with one of these values, or with any word."""
    word = st.one_of(*[st.sampled_from(values)] * 5, _WORDS) if values else None
    return st.tuples(st.just(name), word).map(list) if word is not None else st.just([name])


def _run(*names: str) -> st.SearchStrategy[list[str]]:
    known = st.sampled_from(names).map(lambda name: [str(runs.folder(name))])
    return st.one_of(*[known] * 9, _WORDS.map(lambda word: [word]))


def _alone(word: str) -> list[str]:
    return [word]


def _others(run: list[str]) -> list[str]:
    return ["--others", *run]


def _beside(run: list[str]) -> list[str]:
    return ["--beside", *run]


_COMMON: Final = (_flag("--allow", *runs.ALLOW, "os:getcwd"),)
_ALLOWED: Final = st.just(["--allow", runs.ALLOW[0]])
_FRESH: Final = (
    _flag("--episodes", "1", "2", "0"),
    _flag("--seed", "1", "0"),
    _flag("--replicas", "0", "1"),
    _flag("--greedy"),
    *_COMMON,
)
_PLAYED: Final = (*_FRESH, _flag("--out", "table.parquet", "some/table.parquet"))
_SUBCOMMANDS: Final[dict[str, tuple[list[st.SearchStrategy[list[str]]], tuple[Any, ...]]]] = {
    "run": (
        [_run("plain", "finished", "stopped", "results")],
        (
            _flag("--out", "there", "a/b"),
            _flag("--resume"),
            _flag("--take-over"),
            _flag("--no-keep-checkpoint"),
            _flag("--episodes", "4"),
            _flag("--watch", "off", "file", "serve"),
            *_COMMON,
        ),
    ),
    "recipe": ([], (st.sampled_from(("commons", "studies/time_out", "base")).map(_alone), _flag("--help"))),
    "watch": ([_run(*runs.NAMES)], (_flag("--help"),)),
    "docs": ([], (_flag("--port", "0", "70000"), _flag("--no-browser"))),
    "film": (
        [_run("plain", "finished", "results")],
        (
            *(_flag("--replica", "0", "1"), _flag("--episode", "0", "3")),
            _flag("--out", "film.rrd", "film.gif", "a/film.gif", "film.avi"),
            *(_flag("--every", "1", "5"), _flag("--fps", "5", "0.5"), _flag("--width", "240", "600")),
            *(_run("plain", "results").map(_beside), _flag("--titles", "one", "two")),
            *_COMMON,
        ),
    ),
    "play": (
        [st.one_of(_run("plain", "finished", "results"), st.sampled_from(presets.BOARDS).map(_alone))],
        (
            *(_flag("--agent", "0", "1"), _flag("--replica", "0", "1"), _flag("--steps", "1", "3")),
            *(_flag("--others", "greedy", "random"), _run("plain", "finished").map(_others)),
            *(_flag("--variant", "published", "as_run", "as_run_10_april"), _flag("--seed", "1", "0")),
            *_COMMON,
        ),
    ),
    "report": ([_run("plain")] * 2, (_flag("--out", "report", "a/b"),)),
    "export": ([_run("plain", "finished", "stopped"), st.just(["folder"])], (_flag("--watch", "off"),)),
    "evaluate": ([_run("plain", "finished", "results", "stopped")], _PLAYED),
    "visits": (
        [_run("plain", "finished", "results", "stopped")],
        (*_FRESH, _flag("--figure", "maps.png", "some/maps.png"), _flag("--random")),
    ),
    "crossplay": (
        [_run("plain", "finished"), _run("plain", "finished")],
        (*_PLAYED, _flag("--diagonal", "self", "cross_seed", "selfplay")),
    ),
    "egta": (
        [_run("plain", "finished"), _run("plain", "finished")],
        (
            *(*_PLAYED, _flag("--pairwise"), _flag("--figure", "game.png", "game.gif")),
            *(_flag("--alpha", "1", "50", "0"), _flag("--resamples", "1", "0")),
        ),
    ),
    "schelling": (
        [_run("plain", "finished", "results")],
        (
            *(_flag("--restrained", "sustainable", "random"), _flag("--greedy", "greedy", "sustainable")),
            *(_flag("--episodes", "1", "0"), _flag("--replicas", "1", "2"), _flag("--seed", "1", "0")),
            *(_flag("--figure", "diagram.png", "diagram.gif"), _flag("--out", "table.parquet")),
            *(_flag("--variant", "published", "as_run"), *_COMMON),
        ),
    ),
    "scenarios": (
        [_run("plain", "finished", "results", "stopped")],
        (
            *_PLAYED,
            _flag("--scenarios", "minority_among_greedy", "minority_among_wolves"),
            _flag("--figure", "scores.png", "some/scores.png"),
        ),
    ),
    "exploit": (
        [_run("plain", "finished", "results")],
        (
            *(_flag("--agents", "0", "1"), _flag("--algorithms", "own", "PPO"), _flag("--seeds", "1", "2")),
            *(_flag("--training-episodes", "1"), _flag("--replicas", "1"), _flag("--episodes", "1", "0")),
            *(_flag("--seed", "1", "0"), _flag("--out", "out"), _flag("--dry-run"), *_COMMON),
        ),
    ),
}


def _named(*flags: tuple[str, ...]) -> list[tuple[str, st.SearchStrategy[list[str]]]]:
    return [(name, _flag(name, *values)) for name, *values in flags]


_OF_EXPERIMENTS: Final = _named(
    ("--episodes", "1", "3"),
    ("--replicas", "1", "2"),
    ("--seed", "0", "5", "-1"),
    ("--evaluation-episodes", "1", "0"),
    ("--update-every", "1", "2"),
    ("--device", "cpu", "cuda:0"),
    ("--engine", "eager", "torchrl"),
    ("--name", "mine"),
    ("--game.rules.freeze-steps", "0", "3"),
    ("--game.rules.regrow-prob", "0", "0.5"),
    ("--game.rules.episode-steps", "5"),
    ("--game.rules.window-columns", "3"),
    ("--game.map", "commons", "single_basic"),
    ("--agents.0.algorithm.settings.gamma", "0.9", "nan"),
    ("--agents.0.algorithm.settings.buffer-size", "100"),
    ("--agents.0.algorithm.settings.hidden-cells", "4"),
    ("--agents.0.reward", "team"),
    ("--loggers", "wandb"),
    ("--out", "there", "a/b"),
    ("--watch", "off", "file", "spawn"),
    ("--resume",),
    ("--take-over",),
    ("--no-keep-checkpoint",),
)


_OWN: Final = _named(
    ("--variant", "published", "as_run", "as_run_10_april"),
    ("--neighbour", "greedy", "random"),
    ("--loss", "ppo", "sac"),
    ("--only", "commons"),
    ("--runs", "there"),
    ("--results", "results"),
    ("--processes", "1"),
    ("--epsilon-decay-steps", "500"),
    ("--target-every-episodes", "10"),
)


def _flags_of(recipe: str) -> list[st.SearchStrategy[list[str]]]:
    """The flags that a recipe may have: its own by its text, and those of its experiment."""
    text = (public.ROOT / "recipes" / f"{recipe}.py").read_text()
    own = _OWN if "recipe_main" in text else (*_OWN, *_OF_EXPERIMENTS)
    mine = [flag for name, flag in own if name.removeprefix("--").replace("-", "_") in text]
    return [*mine, *(flag for _, flag in _OF_EXPERIMENTS if "recipe_main" in text)]


@st.composite
def _lines(draw: Any, first: list[st.SearchStrategy[list[str]]], flags: Any, more: list[str]) -> Case:
    """Words of a command line: what it must have, some flags, and now and then any word anywhere."""
    words = [word for own in first for word in draw(own)]
    if first and draw(st.integers(0, 19)) == 0:
        words = words[1:]
    if "--allow" in more and draw(st.integers(0, 5)):
        words += draw(_ALLOWED)
    for own in draw(st.lists(st.sampled_from(flags), max_size=3)):
        words += draw(own)
    chance = draw(st.integers(0, 29))
    if chance == 0:
        words.append("--help")
    elif chance < 4:
        words.insert(draw(st.integers(0, len(words))), draw(_WORDS))
    return Case({"words": [*words, *(word for word in more if word != "--allow")]})


def targets() -> list[Target]:
    """A target for each subcommand, for `cprl` alone, and for each recipe."""
    more = {
        "watch": [],
        "recipe": [],
        "report": [],
        "export": [],
        "docs": [],
        "play": ["--allow"],
    }
    found = [
        _target(f"cprl {name}", _subcommand(name), _lines(first, flags, more.get(name, ["--allow"])))
        for name, (first, flags) in _SUBCOMMANDS.items()
    ]
    alone = _lines([], [_flag(name) for name in ("--version", "--help", "run", "-h", "--", "evaluate")], [])
    found.append(_target("cprl", _subcommand(None), alone))
    for recipe in RECIPES:
        found.append(_target(f"recipes/{recipe}.py", _recipe(recipe), _lines([], _flags_of(recipe), [])))
    return found


def _target(name: str, call: Callable[[Case], Any], lines: st.SearchStrategy[Case]) -> Target:
    return Target(
        name=f"command:{name}",
        kind=cases.COMMAND,
        cases=lines,
        call=call,
        refusals=(),
        is_command=True,
        in_folder=True,
        weight=0,
    )


def _subcommand(name: str | None) -> Callable[[Case], Any]:
    def call(case: Case) -> Any:
        words = ["cprl", *([name] if name else []), *case.arguments["words"]]
        with _harmless(), mock.patch.object(sys, "argv", words):
            cli.main()

    return call


def _recipe(name: str) -> Callable[[Case], Any]:
    path = public.ROOT / "recipes" / f"{name}.py"
    text = path.read_text()
    # Recipes are compiled by torch unless they are told not to, seconds for each case.
    uncompiled = ["--engine", "eager"] if "recipe_main" in text else []

    def call(case: Case) -> Any:
        words = [f"recipes/{name}.py", *case.arguments["words"]]
        words += [] if "--engine" in words else uncompiled
        code = compile(text, str(path), "exec")
        with _harmless(), mock.patch.object(sys, "argv", words):
            exec(code, {"__name__": "__main__", "__file__": str(path)})

    return call


@contextlib.contextmanager
def _harmless() -> Iterator[None]:
    """Trainings stop after two steps; no viewer is opened, no other program replaces this one."""

    def stop(*arguments: Any, **named: Any) -> Any:
        raise runs.Stopped

    import subprocess

    with (
        runs.stopped_after(2),
        mock.patch("os.execvp", stop),
        mock.patch("cprl.docs_cli.Server.serve_forever", stop),
        mock.patch("webbrowser.open", return_value=True),
        mock.patch("cprl.viewer.logger.open_live", return_value=(None, {})),
        mock.patch.object(subprocess, "run", _git_alone),
        mock.patch.object(sys, "path", list(sys.path)),
        mock.patch.object(sys, "stdin", io.StringIO("w.\nf\nz\n\nquit\n")),
    ):
        yield


def _git_alone(*arguments: Any, **named: Any) -> Any:
    """git is not asked, and recipes/reproduce.py starts nothing."""
    if arguments and arguments[0][:1] == ["git"]:
        raise OSError("no git")
    raise runs.Stopped
