"""Commands that play stored agents, none of which learns, in fresh worlds: `cprl film`, `evaluate` ..."""

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import tyro

from cprl.commands.flags import ROWS, Board, FileFlags, Files, Run, Runs, TableFlags, Tables, VariantFlag
from cprl.commons.published import check_board
from cprl.system.defaults import (
    EGTA_RESAMPLES,
    FILM_SEED,
    FILM_SUFFIXES,
    PLAY_SEED,
    SANDBOX_EPISODES,
    SEED,
    STUDY_TABLE,
    Diagonal,
    Fresh,
)
from cprl.system.output import OUT, printed, say
from cprl.system.process import prepare_process
from cprl.system.working import working
from cprl.values import Seed, checked

if TYPE_CHECKING:
    import pyarrow as pa

    from cprl.terminal.tables import Cells


LOOK: Final = ("film", "show", "report", "play", "sandbox")
MEASURE: Final = ("evaluate", "visits", "scenarios", "schelling", "exploit")
COMPARE: Final = ("crossplay", "egta")
"""The commands of this module by their groups in `cprl --help`, in order."""

FreshFlags = Annotated[Fresh, tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class FilmOptions:
    """How a .gif or .mp4 shows an episode, see `cprl.evaluation.film.Style`."""

    beside: tuple[Path, ...] = ()
    """Of a .gif or .mp4: more runs, whose agents play beside them on one clock."""
    titles: tuple[str, ...] = ()
    """Of a .gif or .mp4: one for the run and one for each beside it; by default their institutions, or the
    names of their experiments."""
    every: int | None = None
    """Of a .gif or .mp4: turns from one picture to the next; by default 1 for an .mp4, and for a .gif as many
    as it takes for 300 pictures."""
    fps: float | None = None
    """Of a .gif or .mp4: pictures per second, at most 50; by default 15."""
    width: int | None = None
    """Of a .gif or .mp4, in pixels, at most 1920 and at least 240 for each run; by default 640 for each that
    has room."""


def film(
    run: Run,
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
    given = {name: value for name, value in vars(options).items() if value not in (None, ())}
    is_video = out is not None and out.suffix in FILM_SUFFIXES
    if given and not is_video:
        raise ValueError(f"--{next(iter(given))} is for films; allowed: with --out FILE.gif or FILE.mp4")
    _begin(seed, run, *options.beside)

    from cprl.evaluation.film import Style, film_video
    from cprl.evaluation.film import film as film_run
    from cprl.viewer.page import to_watch

    which: dict[str, Any] = {"replica": replica, "episode": episode, "seed": seed}
    if out is None or not is_video:
        path, played = film_run(run, out, **which)
        say(f"{played.steps} steps, {played.outcome}")
        say(f"Watch: {printed(to_watch(path))}")
        return
    beside = given.pop("beside", ())
    path, episodes = film_video(run, out, beside=beside, style=Style(**given), **which)
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
    _begin(seed, *runs)

    from cprl.evaluation.show import show as show_runs

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
    _begin(seed, *([] if (run / STUDY_TABLE).is_file() else [run]))

    from cprl.studies.report import report as report_on

    path = report_on(run, out, episodes=episodes, seed=seed)
    say(f"{path}: {path.stat().st_size / 1000:.0f} kB; open it in a browser")


def sandbox(*, port: int = 0, out: Path | None = None, episodes: int = SANDBOX_EPISODES) -> None:
    """Open a page with sliders for people who do not program: rules, boards, scripted agents, trainings.

    Args:
        port: Of the page, which is on 127.0.0.1 alone; 0 for any that is free.
        out: Where trainings are kept; by default they are gone when the sandbox is closed.
        episodes: Of a training.
    """
    _begin(0)

    with working("starting"):
        from cprl.evaluation.sandbox import Sandbox

    served = Sandbox(out, port=port, episodes=episodes)
    say(f"{served.address} is open until Ctrl-C")
    try:
        served.server.serve_forever()
    except KeyboardInterrupt:
        say("closed")
    finally:
        served.close()


@dataclass(frozen=True, kw_only=True)
class Session:
    """Who plays among whom, see `cprl.evaluation.play.open_session`."""

    agent: int = 0
    """The index of the one that you play."""
    others: str | None = None
    """The directory of a run, whose agents play, or random, greedy, sustainable, territorial, aggressive or
    pacifist; by default the agents of the run that is the board, else greedy."""
    replica: int | None = None
    """Whose agents play, of a run; by default a typical one, as of cprl film."""
    variant: VariantFlag = "published"
    steps: int | None = None
    """Turns of the episode at most; by default as many as the game has."""
    seed: int | None = None
    """Of all chance, by default 40011; the same seed and the same keys play the same again."""
    decision: int | None = None
    """What you vote for in a game with votes or elections, by its number; by default chance votes."""


def play(board: Board, /, *, session: Annotated[Session, tyro.conf.arg(name="")] = Session()) -> None:
    """Play in the terminal among trained or scripted agents, and measure the episode."""
    check_board(board)
    _begin(PLAY_SEED if session.seed is None else session.seed)

    from cprl.evaluation.play import open_session, play_in_terminal

    play_in_terminal(open_session(board, **vars(session)))


def evaluate(run: Run, /, *, fresh: FreshFlags = Fresh(), files: TableFlags = Tables()) -> None:
    """Play fresh worlds with all replicas of a run, and print the social metrics beside random play's."""
    _begin(fresh.seed, run, files=files)

    from cprl.evaluation.evaluate import evaluate_run
    from cprl.terminal.summary import compared

    table = evaluate_run(run, fresh)
    _show(table, files, [compared(table, "beside random play", names={"trained": "run's agents"})])


def visits(
    run: Run, /, *, fresh: FreshFlags = Fresh(), files: FileFlags = Files(), random: bool = False
) -> None:
    """Play fresh worlds with all replicas of a run, and print how far agents keep to cells of their own.

    The figure has a map for each agent of where it spends its time, in the first of the replicas.

    Args:
        random: Draw random agents in the same worlds instead.
    """
    if random and files.figure is None:
        raise ValueError("--random says who is drawn; allowed: with --figure FILE")
    _begin(fresh.seed, run, files=files)

    from cprl.experimental.territory import draw_visits, territory_cells, territory_of
    from cprl.training.stored import load

    loaded = load(run)
    table = territory_of(loaded, fresh)
    policy: Any = "random" if random else "trained"
    draw = partial(draw_visits, table, loaded.game.map, policy=policy)
    _show(table, files, [territory_cells(table)], draw=draw)


def crossplay(
    runs: Runs,
    /,
    *,
    fresh: FreshFlags = Fresh(),
    diagonal: Diagonal = "self",
    files: FileFlags = Files(),
) -> None:
    """Play agents of each run among agents of each other run, and print how all fare.

    The figure shows what focal agents gain, and what it costs the background agents.

    Args:
        diagonal: Whom a run's agents meet on the diagonal: "self", the agents that they were trained with,
            or "cross_seed", agents of the run's next replica.
    """
    named = runs_by_name(runs)
    _begin(fresh.seed, *_paths(named), files=files)

    from cprl.evaluation.cross_play import crossplay as play_each_other
    from cprl.evaluation.cross_play import crossplay_cells, draw_gains

    table = play_each_other(named, fresh, diagonal=diagonal)
    _show(table, files, crossplay_cells(table), draw=partial(draw_gains, table))


@dataclass(frozen=True, kw_only=True)
class Mixes:
    """Who plays in all mixes, see `cprl.evaluation.schelling.schelling`."""

    restrained: str = "sustainable"
    """Who plays restrained: random, greedy, sustainable, territorial, aggressive, pacifist, or a run's
    directory, whose agents play."""
    greedy: str = "greedy"
    """Who plays greedy, of the same."""
    episodes: int = 5
    """Episodes of each replica, in each choice of who plays where, each in its own world; with N agents there
    are N (N - 1) + 2 choices."""
    replicas: tuple[int, ...] = ()
    """Which replicas play, by number; by default all that every run has, and 0 to 7 of scripted agents."""
    seed: int = SEED
    """Of the worlds and all chance; the same one gives the same numbers."""


def schelling(
    board: Board,
    /,
    *,
    variant: VariantFlag = "published",
    mixes: Annotated[Mixes, tyro.conf.arg(name="")] = Mixes(),
    files: FileFlags = Files(),
) -> None:
    """Play all mixes of restrained and greedy agents, and print which social dilemma they are in.

    The figure is the Schelling diagram.
    """
    check_board(board)
    _begin(mixes.seed, files=files)

    from cprl.evaluation.play import board_named
    from cprl.evaluation.schelling import draw_schelling, schelling_cells
    from cprl.evaluation.schelling import schelling as play_all_mixes

    game, run = board_named(board, variant)
    fresh = Fresh(episodes=mixes.episodes, replicas=mixes.replicas, seed=mixes.seed)
    players = {"restrained": mixes.restrained, "greedy": mixes.greedy}
    table = play_all_mixes(game if run is None else run, fresh, **players)
    _show(table, files, schelling_cells(table), draw=partial(draw_schelling, table))


def egta(
    runs: Runs,
    /,
    *,
    fresh: FreshFlags = Fresh(episodes=5),
    pairwise: bool = False,
    resamples: int = EGTA_RESAMPLES,
    files: FileFlags = Files(),
) -> None:
    """Play all compositions of agents of runs, and print which runs last: equilibria, alpha-rank, replicator
    dynamics (extra "theory").

    The figure shows the dynamics, and the shares by alpha-rank.

    Args:
        pairwise: Play one agent of each run among agents of each other run, as `cprl crossplay` does. This is
            cheaper, but leaves out other mixes if there are more than two agents.
        resamples: Of the replicas, for intervals.
    """
    named = runs_by_name(runs)
    _begin(fresh.seed, *_paths(named), files=files)

    from cprl.evaluation.cross_play import crossplay
    from cprl.experimental.empirical_game import (
        analyse,
        draw_egta,
        egta_cells,
        pairwise_game,
        play_empirical_game,
    )
    from cprl.experimental.solutions import check_extras

    check_extras()
    game = pairwise_game(crossplay(named, fresh)) if pairwise else play_empirical_game(named, fresh)
    rows = tuple(path for path in files.out if path.suffix == ROWS)
    replace(files, out=rows).write(game)  # An analysis that fails loses no episodes.
    analysis = analyse(game, resamples=resamples)
    rest = replace(files, out=tuple(path for path in files.out if path not in rows))
    _show(game, rest, egta_cells(analysis), draw=partial(draw_egta, analysis))


def scenarios(
    run: Run,
    /,
    *,
    scenarios: tuple[str, ...] = (),
    fresh: FreshFlags = Fresh(episodes=5),
    files: FileFlags = Files(),
) -> None:
    """Play a run's agents among agents that they never met, and print how they fare beside random and greedy
    agents in their places.

    The figure shows the returns in each scenario.

    Args:
        scenarios: Their names, e.g. minority_among_greedy; by default all of the run's game.
    """
    _begin(fresh.seed, run, files=files)

    from cprl.evaluation.scenarios import draw_scenarios, run_scenarios, scenario_cells

    table = run_scenarios(run, fresh, scenarios=scenarios)
    _show(table, files, scenario_cells(table), draw=partial(draw_scenarios, table))


@dataclass(frozen=True, kw_only=True)
class Responses:
    """Which best responses are trained."""

    agents: tuple[int, ...] = (0,)
    """Indices of the agents that are replaced, one at a time; each costs as many trainings."""
    algorithms: tuple[str, ...] = ()
    """What responses learn by: own, the algorithm of the replaced agent, DQN, PPO; by default own and PPO, or
    DQN if that is PPO; see docs/evaluation.md."""
    seeds: int = 3
    """Trainings by each algorithm."""
    training_episodes: int | None = None
    """Episodes of each training; by default a quarter of the run's, if somebody learned in it."""
    device: str = "cpu"
    """Where responses learn, e.g. cpu or cuda:0."""


def exploit(
    run: Annotated[Path, tyro.conf.arg(metavar="RUN")],
    /,
    *,
    responses: Annotated[Responses, tyro.conf.arg(name="")] = Responses(),
    fresh: FreshFlags = Fresh(),
    out: tyro.conf.UseAppendAction[tuple[Path, ...]] = (),
    jobs: int | None = None,
    dry_run: bool = False,
) -> None:
    """Train best responses to the agents of a run, and print what they gain: how exploitable the run is.

    So many fresh episodes choose a response, in worlds of the next seed, and as many measure what it gains.
    The replicas that are responded to are 0 and those that follow it. You can stop it; the same command
    continues, and plays again with what is trained.

    Args:
        run: The directory of a run that has ended, or its results.
        out: The directory of trainings and results, by default exploit/NAME; or a new file with the tables
            that are printed (.txt, .md, .tex or .csv). May be repeated.
        jobs: Processes that train at the same time, one for each place and algorithm.
        dry_run: List all trainings and their states; run and write nothing.
    """
    from cprl.terminal.tables import SUFFIXES

    files = Tables(out=tuple(path for path in out if path.suffix in SUFFIXES))
    folders = [path for path in out if path.suffix not in SUFFIXES]
    if len(folders) > 1:
        raise ValueError(f"--out names the directories {', '.join(map(str, folders))}; allowed: one")
    _begin(fresh.seed, run, files=files)

    from cprl.commands.studies import StudyOptions, carry_out, executor_of
    from cprl.studies.exploit import TABLE, exploitability_cells, measure, plan_responses
    from cprl.studies.study import directory_of
    from cprl.terminal.tables import show

    plan = plan_responses(run, fresh, **vars(responses))
    folder = directory_of(plan.study, folders[0] if folders else plan.out)
    options = StudyOptions(out=folder, jobs=jobs, dry_run=dry_run, figures=False)
    executor_of(options)
    if not dry_run:
        plan.claim(folder)
    carry_out(plan.study, options, ["cprl", *sys.argv[1:]])
    if dry_run:
        return
    played = measure(plan, folder)
    tables = list(exploitability_cells(played))
    show(tables)
    say(f"Episodes: {folder / TABLE}")
    files.write(played, tables)


def _begin(seed: int | None, *runs: Path | str, files: Tables = Tables()) -> None:
    """Refuse files that are there and runs that are not, before what plays agents is imported; prepare the
    process."""
    with working("starting"):
        from cprl.runs.recipe import read_recipe

        seed = checked("--seed", FILM_SEED if seed is None else seed, Seed)
        files.check()
        for run in runs:
            read_recipe(Path(run))
        prepare_process(seed)
        import_module("cprl.evaluation.lanes")


def _show(
    table: "pa.Table",
    files: Tables,
    cells: "Iterable[Cells]",
    *,
    draw: Callable[..., Path] | None = None,
) -> None:
    """Print tables below the heading of what was played, or every row; write files, and draw."""
    from cprl.evaluation.lanes import said
    from cprl.terminal.tables import show

    if files.csv:
        _print_rows(table)
        return
    tables = list(cells)
    heading = said(table, "heading")
    show([heading, *tables])
    weights = said(table, "weights")
    if weights:
        say(f"Weights: {weights}")
    files.write(table, tables, notes=[heading])
    if isinstance(files, Files) and files.figure is not None and draw is not None:
        say(f"Figure: {draw(files.figure, width=files.figure_width)}")


def _print_rows(table: "pa.Table") -> None:
    from pyarrow.csv import write_csv
    from pyarrow.types import is_list

    rows = BytesIO()
    write_csv(table.select([field.name for field in table.schema if not is_list(field.type)]), rows)
    OUT.write(rows.getvalue().decode())


def _paths(named: Sequence[str] | Mapping[str, str]) -> Iterable[str]:
    return named.values() if isinstance(named, Mapping) else named


def runs_by_name(words: Sequence[str]) -> list[str] | dict[str, str]:
    """Return runs as `crossplay` takes them: paths, or a table where one has a name, NAME=PATH."""
    pairs = []
    for word in words:
        name, equals, path = word.partition("=")
        # A path may have "=" itself.
        is_named = equals and name and "/" not in name and not Path(word).exists()
        pairs.append((name, path) if is_named else ("", word))
    if not any(name for name, _ in pairs):
        return list(words)
    named = [(name or Path(path).resolve().name, path) for name, path in pairs]
    names = [name for name, _ in named]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name} names {names.count(name)} runs; allowed: each its own, NAME=PATH")
    return dict(named)
