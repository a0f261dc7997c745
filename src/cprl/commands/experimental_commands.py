"""The experimental commands: `cprl egta`, `exploit`, `schelling`, `search` and `visits`."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import tyro

from cprl.commands.flags import (
    ROWS,
    BoardArgument,
    FileFlags,
    ResultFiles,
    RunArgument,
    RunsArgument,
    TableFiles,
    VariantFlag,
)
from cprl.commands.play_stored import FreshFlags, begin_playing, paths_of, runs_by_name, show_played
from cprl.commands.studies import (
    StudyOptions,
    VariedOptions,
    carry_out,
    executor_of,
    read_recipe_and_options,
    run_resumable,
    say_result,
    study_fields,
)
from cprl.commons.named_games import check_game_source
from cprl.system.defaults import EGTA_RESAMPLES, SEED, Fresh
from cprl.system.output import say
from cprl.system.waiting_room import experimental

_ABOUT_SEARCH: Final = "Search for good values of a recipe's experiment by Optuna, point by point."
_BEST: Final = 10
"""Points of a search that are printed."""


@dataclass(frozen=True, kw_only=True)
class Mixes:
    """Who plays in all mixes, see `cprl.experimental.schelling.schelling`."""

    restrained: str = "sustainable"
    """The agents that play restrained: random, greedy, sustainable, territorial, aggressive, pacifist, or a
    run's directory, whose agents play."""
    greedy: str = "greedy"
    """The agents that play greedy, of the same."""
    episodes: int = 5
    """Episodes of each replica, in each choice of who plays where, each in its own world; with N agents there
    are N (N - 1) + 2 choices."""
    replicas: tuple[int, ...] = ()
    """Which replicas play, by number; by default all that every run has, and 0 to 7 of scripted agents."""
    seed: int = SEED
    """The seed of the worlds and all chance; the same one gives the same numbers."""


def schelling(
    board: BoardArgument,
    /,
    *,
    variant: VariantFlag = "published",
    mixes: Annotated[Mixes, tyro.conf.arg(name="")] = Mixes(),
    files: FileFlags = ResultFiles(),
) -> None:
    """Play all mixes of restrained and greedy agents, and print which social dilemma they are in.

    The figure is the Schelling diagram.
    """
    check_game_source(board)
    begin_playing(mixes.seed, files=files)

    from cprl.evaluation.play import game_and_run

    play_all_mixes = experimental("schelling.schelling")
    schelling_tables = experimental("schelling.schelling_tables")
    draw_schelling = experimental("schelling.draw_schelling")
    game, run = game_and_run(board, variant)
    fresh = Fresh(episodes=mixes.episodes, replicas=mixes.replicas, seed=mixes.seed)
    players = {"restrained": mixes.restrained, "greedy": mixes.greedy}
    where = game if run is None else run
    table = play_all_mixes(where, fresh, **players)
    show_played(table, files, schelling_tables(table), draw=partial(draw_schelling, table))


def egta(
    runs: RunsArgument,
    /,
    *,
    fresh: FreshFlags = Fresh(episodes=5),
    pairwise: bool = False,
    resamples: int = EGTA_RESAMPLES,
    files: FileFlags = ResultFiles(),
) -> None:
    """Play all compositions of agents of runs, and print which runs last: equilibria, alpha-rank, replicator
    dynamics (extra "theory").

    The figure shows the dynamics, and the shares by alpha-rank.

    Args:
        pairwise: Play one agent of each run among agents of each other run, as `cprl crossplay` does. This is
            cheaper, but leaves out other mixes if there are more than two agents.
        resamples: Of the replicas, for intervals.
    """
    runs_named = runs_by_name(runs)
    begin_playing(fresh.seed, *paths_of(runs_named), files=files)

    from cprl.evaluation.cross_play import crossplay

    pairwise_game = experimental("empirical_game.pairwise_game")
    play_empirical_game = experimental("empirical_game.play_empirical_game")
    analyse = experimental("empirical_game.analyse")
    egta_tables = experimental("empirical_game.egta_tables")
    draw_egta = experimental("empirical_game.draw_egta")
    check_extras = experimental("solutions.check_extras")
    check_extras()
    game = pairwise_game(crossplay(runs_named, fresh)) if pairwise else play_empirical_game(runs_named, fresh)
    rows = tuple(path for path in files.out if path.suffix == ROWS)
    replace(files, out=rows).write(game)  # An analysis that fails loses no episodes.
    analysis = analyse(game, resamples=resamples)
    rest = replace(files, out=tuple(path for path in files.out if path not in rows))
    show_played(game, rest, egta_tables(analysis), draw=partial(draw_egta, analysis))


@dataclass(frozen=True, kw_only=True)
class Responses:
    """Which best responses are trained."""

    agents: tuple[int, ...] = (0,)
    """Indices of the agents that are replaced, one at a time; each costs as many trainings."""
    algorithms: tuple[str, ...] = ()
    """The algorithms by which responses learn: own, the algorithm of the replaced agent, DQN, PPO; by default
    own and PPO, or DQN if that is PPO; see docs/evaluation.md."""
    seeds: int = 3
    """Trainings by each algorithm."""
    training_episodes: int | None = None
    """Episodes of each training; by default a quarter of the run's, if somebody learned in it."""
    device: str = "cpu"
    """The device on which responses learn, e.g. cpu or cuda:0."""


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
    from cprl.terminal.text_tables import WRITERS

    files = TableFiles(out=tuple(path for path in out if path.suffix in WRITERS))
    folders = [path for path in out if path.suffix not in WRITERS]
    if len(folders) > 1:
        raise ValueError(f"--out names the directories {', '.join(map(str, folders))}; allowed: one")
    begin_playing(fresh.seed, run, files=files)

    from cprl.studies.study import directory_of
    from cprl.terminal.text_tables import print_tables

    plan_responses = experimental("exploit.plan_responses")
    measure = experimental("exploit.measure")
    exploitability_tables = experimental("exploit.exploitability_tables")
    episodes_file = experimental("exploit.TABLE")
    plan = plan_responses(run, fresh, **vars(responses))
    folder = directory_of(plan.study, next(iter(folders), plan.out))
    options = StudyOptions(out=folder, jobs=jobs, dry_run=dry_run, figures=False)
    executor_of(options)
    if not dry_run:
        plan.claim(folder)
    carry_out(plan.study, options, ["cprl", *sys.argv[1:]])
    if dry_run:
        return
    played = measure(plan, folder)
    tables = list(exploitability_tables(played))
    print_tables(tables)
    say(f"Episodes: {folder / episodes_file}")
    files.write(played, tables)


@dataclass(frozen=True, kw_only=True)
class SearchOptions(VariedOptions):
    """What is searched, and how it is run."""

    points: int = 30
    """The number of points that Optuna (extra "optuna") proposes."""
    metric: str = "collective_return"
    """The metric whose best value is searched."""
    direction: Literal["maximise", "minimise"] = "maximise"
    """The direction in which it is better: high or low."""
    over: Literal["evaluation", "training"] = "evaluation"
    """The episodes that count: those of the evaluation, or the last 30 of the training."""
    sampler: Literal["tpe", "random", "gp"] = "tpe"
    """The sampler that proposes points."""
    at_once: int = 4
    """Points that are proposed together; a multiple of --jobs keeps all of them busy."""


def search(words: Sequence[str], /) -> None:
    """Search for good values by Optuna: cprl search RECIPE --vary ... --points 30

    Args:
        words: what stands after `cprl search`, see `sweep`.
    """
    experiment, options = read_recipe_and_options(words, SearchOptions(), "cprl search", about=_ABOUT_SEARCH)

    from cprl.studies.factors import factors_of
    from cprl.studies.study import directory_of

    run_search = experimental("search.run_search")
    new_search = experimental("search.Search")
    plan = new_search(experiment, factors_of(experiment, options.vary), **study_fields(options))
    command = ["cprl", "search", *words]
    executor = executor_of(options)
    if options.dry_run:
        factors = ", ".join(f"{name}: {factor}" for name, factor in plan.factors.items())
        out = directory_of(plan.study_of([]), options.out)
        say(f"{plan.points} points of {factors}, found one after the other, in {out}; nothing was written")
        return
    result = run_resumable(partial(run_search, plan), options, executor, command)
    _say_best(result)
    say_result(result, command)


def _say_best(result: Any) -> None:
    """Print the best points of a search, and how many were refused.

    Args:
        result: a `cprl.experimental.search.SearchResult`.
    """
    plan = result.search
    best = "highest" if plan.direction == "maximise" else "lowest"
    say(f"{plan.name}: {len(result.points)} points; the {best} {plan.metric}, means over replicas:")
    for point in result.ranked[:_BEST]:
        say(f"  {point.value:10.6g}  {point.name}")
    refused = [point for point in result.points if point.reason]
    if refused:
        say(f"  {len(refused)} points were refused, e.g. {refused[0].name}: {refused[0].reason}")


def visits(
    run: RunArgument,
    /,
    *,
    fresh: FreshFlags = Fresh(),
    files: FileFlags = ResultFiles(),
    random: bool = False,
) -> None:
    """Play fresh worlds with all replicas of a run, and print how far agents keep to cells of their own.

    The figure has a map for each agent of where it spends its time, in the first of the replicas.

    Args:
        random: Draw random agents in the same worlds instead.
    """
    if random and files.figure is None:
        raise ValueError("--random says who is drawn; allowed: with --figure FILE")
    begin_playing(fresh.seed, run, files=files)

    from cprl.training.stored import load

    territory_of = experimental("territory.territory_of")
    territory_table = experimental("territory.territory_table")
    draw_visits = experimental("territory.draw_visits")
    loaded = load(run)
    table = territory_of(loaded, fresh)
    policy: Any = "random" if random else "trained"
    draw = partial(draw_visits, table, loaded.game.map, policy=policy)
    show_played(table, files, [territory_table(table)], draw=draw)
