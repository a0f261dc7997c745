"""Commands that let the agents of stored runs play in fresh worlds: `cprl film`, `play`, `evaluate` etc.

None of the agents learns. Each command is a function; tyro makes its flags from the annotations.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cprl.commands.flags import (
    BoardArgument,
    FileFlags,
    ResultFiles,
    RunArgument,
    RunsArgument,
    TableFiles,
    TableFlags,
    VariantFlag,
)
from cprl.commons.named_games import check_game_source
from cprl.system.defaults import (
    FILM_SEED,
    FILM_SUFFIXES,
    PLAY_SEED,
    SEED,
    STUDY_TABLE,
    Diagonal,
    Fresh,
)
from cprl.system.output import OUT, quote_command, say
from cprl.system.process import prepare_process
from cprl.system.working import working
from cprl.values import Seed, checked

if TYPE_CHECKING:
    import pyarrow as pa

    from cprl.terminal.text_tables import TextTable


FreshFlags = Annotated[Fresh, tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class FilmOptions:
    """The look of a film that is a .gif or .mp4, see `cprl.evaluation.film.Style`."""

    beside: tuple[Path, ...] = ()
    """More runs, whose agents play beside them on one clock; for a .gif or .mp4."""
    titles: tuple[str, ...] = ()
    """A title for the run and one for each beside it, for a .gif or .mp4; by default their institutions, or
    the names of their experiments."""
    every: int | None = None
    """Steps from one picture to the next of a .gif or .mp4; by default 1 for an .mp4, and for a .gif as many
    as it takes for 300 pictures."""
    fps: float | None = None
    """Pictures per second of a .gif or .mp4, at most 50; by default 15."""
    width: int | None = None
    """The width of a .gif or .mp4 in pixels, at most 1920 and at least 240 for each run; by default 640 for
    each that has room."""


def film(
    run: RunArgument,
    /,
    *,
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
    out: Path | None = None,
    options: Annotated[FilmOptions, tyro.conf.arg(name="")] = FilmOptions(),
) -> None:
    """Play a fresh episode with the agents of a run, and record it for the Rerun viewer or as a film.

    Args:
        replica: Whose agents play; by default, without --episode, those of a typical replica, whose boards
            last nearest to the median over replicas.
        episode: Which of the fresh episodes; the same number plays the same again. By default, without
            --replica, a typical one of the first five.
        seed: Of the worlds and all chance, by default 20011; not that of the training. With the seed of
            cprl evaluate, 30011 by default, the world of its episode E of replica R is
            --episode R x EPISODES + E; what agents draw by chance differs. The run's own evaluation plays by
            the seed of its experiment + 1.
        out: What is written: a recording for the viewer (.rrd), or a film of the board, the stock and the
            harvests (.gif, or .mp4, which wants the extra "film"); by default film-<replica>-<episode>.rrd in
            the run's directory.
    """
    if out is not None and out.suffix not in (".rrd", *FILM_SUFFIXES):
        raise ValueError(f"--out is {out}; allowed: a name that ends in .rrd, {', '.join(FILM_SUFFIXES)}")
    settings = {name: value for name, value in vars(options).items() if value not in (None, ())}
    is_video = out is not None and out.suffix in FILM_SUFFIXES
    if settings and not is_video:
        raise ValueError(f"--{next(iter(settings))} is for films; allowed: with --out FILE.gif or FILE.mp4")
    begin_playing(seed, run, *options.beside)

    from cprl.evaluation.film import Style, film_episode, record_episode
    from cprl.viewer.page import to_watch

    which: dict[str, Any] = {"replica": replica, "episode": episode, "seed": seed}
    if out is None or not is_video:
        path, played = record_episode(run, out, **which)
        say(f"{played.steps} steps, {played.outcome}")
        say(f"Watch: {quote_command(to_watch(path))}")
        return
    beside = settings.pop("beside", ())
    path, episodes = film_episode(run, out, beside=beside, style=Style(**settings), **which)
    for path_of_run, played in zip((run, *beside), episodes, strict=True):
        say(f"{f'{path_of_run}: ' if beside else ''}{played.steps} steps, {played.outcome}")
    say(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def show(
    runs: Annotated[
        tuple[Path, ...],
        tyro.conf.arg(
            metavar="RUN [RUN ...]",
            help="One to six directories of runs, or their results.",
            help_behavior_hint="",
        ),
    ],
    /,
    *,
    out: Path | None = None,
    titles: tuple[str, ...] = (),
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
) -> None:
    """Play a fresh episode with the agents of each run, and write one page for any browser of all of them.

    Args:
        out: The page, an .html, which opens from the disk without a network; by default
            show-<replica>-<episode>.html in the directory of the first run.
        titles: One for each run; by default their institutions, or the names of their experiments.
        replica: Whose agents play, as of cprl film; by default of each run those of a typical replica.
        episode: Which of the fresh episodes, as of cprl film.
        seed: Of the worlds and all chance, as of cprl film.
    """
    if not runs:
        raise ValueError("no run is named; allowed: one to six")
    begin_playing(seed, *runs)

    from cprl.web.show import show as show_runs

    run, *beside = runs
    which: dict[str, Any] = {"replica": replica, "episode": episode, "seed": seed}
    path, episodes = show_runs(run, out, beside=beside, titles=titles, **which)
    for path_of_run, played in zip(runs, episodes, strict=True):
        say(f"{path_of_run}: {played.steps} steps, {played.outcome}")
    say(f"{path}: {path.stat().st_size / 1000:.0f} kB; open it in a browser")


def report(run: Path, /, *, out: Path | None = None, episodes: int = 20, seed: int = SEED) -> None:
    """Write a page for any browser about a run or a study: its results, an episode, how to run it again.

    Args:
        run: The directory of a run or of a study, or their results.
        out: The page, an .html, which opens from the disk without a network; by default report.html in that
            directory.
        episodes: Of a run alone, how many fresh ones each replica plays, as of cprl evaluate.
        seed: Of a run alone, of the worlds and all chance, as of cprl evaluate.
    """
    begin_playing(seed, *([] if (run / STUDY_TABLE).is_file() else [run]))

    from cprl.web.report import report as report_on

    path = report_on(run, out, episodes=episodes, seed=seed)
    say(f"{path}: {path.stat().st_size / 1000:.0f} kB; open it in a browser")


@dataclass(frozen=True, kw_only=True)
class SessionOptions:
    """The agents of an episode that a person plays, see `cprl.evaluation.play.open_session`."""

    agent: int = 0
    """The index of the agent that you play."""
    others: str | None = None
    """The other agents: the directory of a run, or random, greedy, sustainable, territorial, aggressive or
    pacifist; by default the agents of the run that is the board, else greedy."""
    replica: int | None = None
    """The replica of a run whose agents play; by default a typical one, as of cprl film."""
    variant: VariantFlag = "published"
    steps: int | None = None
    """Steps of the episode at most; by default as many as the game has."""
    seed: int | None = None
    """The seed of all chance, by default 40011; the same seed and the same keys play the same again."""
    decision: int | None = None
    """The number of the choice that you vote for in a game with votes or elections; by default random."""


def play(
    board: BoardArgument, /, *, session: Annotated[SessionOptions, tyro.conf.arg(name="")] = SessionOptions()
) -> None:
    """Play in the terminal among trained or scripted agents, and measure the episode."""
    check_game_source(board)
    seed = PLAY_SEED if session.seed is None else session.seed
    begin_playing(seed)

    from cprl.commands.play_by_keys import play_in_terminal
    from cprl.evaluation.play import open_session

    play_in_terminal(open_session(board, **vars(session)))


def evaluate(run: RunArgument, /, *, fresh: FreshFlags = Fresh(), files: TableFlags = TableFiles()) -> None:
    """Play fresh worlds with all replicas of a run, and print the social metrics beside random play's."""
    begin_playing(fresh.seed, run, files=files)

    from cprl.evaluation.evaluate import evaluate_run
    from cprl.terminal.summary import comparison_table

    table = evaluate_run(run, fresh)
    show_played(
        table, files, [comparison_table(table, "beside random play", names={"trained": "run's agents"})]
    )


def crossplay(
    runs: RunsArgument,
    /,
    *,
    fresh: FreshFlags = Fresh(),
    diagonal: Diagonal = "self",
    files: FileFlags = ResultFiles(),
) -> None:
    """Play agents of each run among agents of each other run, and print how all fare.

    The figure shows what focal agents gain, and what it costs the background agents.

    Args:
        diagonal: Whom a run's agents meet on the diagonal: "self", the agents that they were trained with,
            or "cross_seed", agents of the run's next replica.
    """
    runs_named = runs_by_name(runs)
    begin_playing(fresh.seed, *paths_of(runs_named), files=files)

    from cprl.evaluation.cross_play import crossplay as play_each_other, crossplay_tables, draw_gains

    table = play_each_other(runs_named, fresh, diagonal=diagonal)
    show_played(table, files, crossplay_tables(table), draw=partial(draw_gains, table))


def scenarios(
    run: RunArgument,
    /,
    *,
    scenarios: tuple[str, ...] = (),
    fresh: FreshFlags = Fresh(episodes=5),
    files: FileFlags = ResultFiles(),
) -> None:
    """Play a run's agents among agents that they never met, and print how they fare beside random and greedy
    agents in their places.

    The figure shows the returns in each scenario.

    Args:
        scenarios: Their names, e.g. minority_among_greedy; by default all of the run's game.
    """
    begin_playing(fresh.seed, run, files=files)

    from cprl.evaluation.scenarios import draw_scenarios, run_scenarios, scenario_tables

    table = run_scenarios(run, fresh, scenarios=scenarios)
    show_played(table, files, scenario_tables(table), draw=partial(draw_scenarios, table))


def begin_playing(seed: int | None, *runs: Path | str, files: TableFiles = TableFiles()) -> None:
    """Begin a command that plays: refuse existing files and missing runs, then import torch.

    Args:
        seed: the seed of the worlds; None for that of films.
        runs: the directories of the runs that play.
        files: the files that the command will write.
    """
    with working("starting"):
        from cprl.runs.recipe import read_recipe

        if seed is None:
            seed = FILM_SEED
        checked("--seed", seed, Seed)
        files.check()
        for run in runs:
            read_recipe(Path(run))
        prepare_process(seed)
        import_module("cprl.evaluation.populations")


def show_played(
    table: "pa.Table",
    files: TableFiles,
    cells: "Iterable[TextTable]",
    *,
    draw: Callable[..., Path] | None = None,
) -> None:
    """Print what was played, as tables below a heading or as CSV rows; write the files, draw the figure."""
    from cprl.evaluation.populations import table_note
    from cprl.runs.episodes import csv_text
    from cprl.terminal.text_tables import print_tables

    if files.csv:
        OUT.write(csv_text(table))
        return
    tables = list(cells)
    heading = table_note(table, "heading")
    print_tables([heading, *tables])
    weights = table_note(table, "weights")
    if weights:
        say(f"Weights: {weights}")
    files.write(table, tables, notes=[heading])
    if isinstance(files, ResultFiles) and files.figure is not None and draw is not None:
        say(f"Figure: {draw(files.figure, width=files.figure_width)}")


def paths_of(runs: Sequence[str] | Mapping[str, str]) -> Iterable[str]:
    """Return the paths of runs, whether or not they have names."""
    return runs.values() if isinstance(runs, Mapping) else runs


def runs_by_name(words: Sequence[str]) -> list[str] | dict[str, str]:
    """Return the runs of a command line: a list of paths, or paths by name if any word is NAME=PATH."""
    pairs = [_name_and_path(word) for word in words]
    if not any(name for name, _ in pairs):
        return list(words)
    pairs = [(name or Path(path).resolve().name, path) for name, path in pairs]
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name} names {names.count(name)} runs; allowed: each its own, NAME=PATH")
    return dict(pairs)


def _name_and_path(word: str) -> tuple[str, str]:
    """Return the name and the path of a run; a path may have "=" itself."""
    name, equals, path = word.partition("=")
    if equals and name and "/" not in name and not Path(word).exists():
        return name, path
    return "", word
