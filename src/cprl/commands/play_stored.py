"""What plays stored agents, none of which learns, in fresh worlds: `cprl film`, `evaluate`, `egta` ..."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import tyro
from rich.table import Table

from cprl.arguments import EGTA_RESAMPLES, FILM_SEED, FILM_SUFFIXES, SEED, Diagonal
from cprl.commands.recipe import Allow, make_importable
from cprl.commands.studies import StudyOptions, carry_out, executor_of
from cprl.presets import Variant, check_board
from cprl.runs.files import refuse_to_write_over
from cprl.runs.recipe import read_recipe
from cprl.system.output import OUT, console, printed, say
from cprl.system.process import prepare_process

if TYPE_CHECKING:
    import pyarrow as pa

Policy = Literal["trained", "random"]


@dataclass(frozen=True, kw_only=True)
class Fresh:
    """How stored agents play fresh worlds."""

    episodes: int
    """Of each replica, in each choice of who plays where."""
    greedy: bool = False
    """Whether stored agents play what they hold best, without exploring or drawing."""
    seed: int = SEED
    """Of the worlds and all chance; the same one gives the same numbers."""
    replicas: tuple[int, ...] = ()
    """Their numbers; by default all that every run has."""
    allow: Allow = ()
    """Code of your own, module:Class, that a run may import; see docs/experiments.md."""


FreshFlags = Annotated[Fresh, tyro.conf.arg(name="")]
_TWENTY: Final = Fresh(episodes=20)
_FIVE: Final = Fresh(episodes=5)


def film(
    run: Path,
    /,
    *,
    beside: tuple[Path, ...] = (),
    titles: tuple[str, ...] = (),
    replica: int = 0,
    episode: int = 0,
    seed: int = FILM_SEED,
    out: Path | None = None,
    every: int | None = None,
    fps: float | None = None,
    width: int | None = None,
    allow: Allow = (),
) -> None:
    """Lets the agents of a run play a fresh episode, recorded for the Rerun viewer or as a film.

    Args:
        run: the run's directory, or its results.
        beside: of a .gif or .mp4: more runs, whose agents play beside them on one clock.
        titles: of a .gif or .mp4: one for the run and one for each beside it; by default their institutions,
            or the names of their experiments.
        replica: whose agents.
        episode: which of the fresh episodes; the same number plays the same again.
        seed: of the worlds and all chance. With the seed of cprl evaluate, 30011 by default, the world of its
            episode E of replica R is --episode R x EPISODES + E; what agents draw by chance differs. The
            run's own evaluation plays by the seed of its experiment + 1.
        out: what is written: a recording for the viewer (.rrd), or a film of the board, the stock and the
            harvests (.gif, or .mp4, which wants the extra "film"); by default film-<replica>-<episode>.rrd in
            the run's directory.
        every: of a .gif or .mp4: turns from one picture to the next; by default 1 for an .mp4, and for a .gif
            as many as it takes for 300 pictures.
        fps: of a .gif or .mp4: pictures per second, at most 50; by default 15.
        width: of a .gif or .mp4, in pixels, at most 1920 and at least 240 for each run; by default 640 for
            each that has room.
        allow: code of your own, module:Class, that the run may import; see docs/experiments.md.
    """
    flags: dict[str, Any] = {"beside": beside, "titles": titles, "every": every, "fps": fps, "width": width}
    given = {name: value for name, value in flags.items() if value not in (None, ())}
    if out is not None and out.suffix not in (".rrd", *FILM_SUFFIXES):
        raise ValueError(f"--out is {out}; allowed: a name that ends in .rrd, {', '.join(FILM_SUFFIXES)}")
    is_video = out is not None and out.suffix in FILM_SUFFIXES
    if given and not is_video:
        raise ValueError(f"--{next(iter(given))} is for films; allowed: with --out FILE.gif or FILE.mp4")
    make_importable(allow)
    check_runs(run, *beside)

    from cprl.evaluation.film import film as film_run
    from cprl.evaluation.film import film_video
    from cprl.viewer.page import to_watch

    prepare_process(seed)
    which: dict[str, Any] = {"replica": replica, "episode": episode, "seed": seed, "allow": allow}
    if out is not None and is_video:
        path, episodes = film_video(run, out, **which, **given)
        for name, played in zip((run, *beside), episodes, strict=True):
            say(f"{f'{name}: ' if beside else ''}{played.steps} steps, {played.outcome}")
        say(f"{path}: {path.stat().st_size / 1000:.0f} kB")
    else:
        path, played = film_run(run, out, **which)
        say(f"{played.steps} steps, {played.outcome}")
        say(f"Watch: {printed(to_watch(path))}")


def evaluate(run: Path, /, *, fresh: FreshFlags = _TWENTY, out: Path | None = None) -> None:
    """Lets all replicas of a run play fresh worlds, and prints the social metrics beside the random policy's.

    Args:
        run: the run's directory, or its results; of one that has not ended the newest checkpoint plays.
        out: a parquet file to be, with every episode.
    """
    make_importable(fresh.allow)
    check_files(out)
    check_runs(run)

    from cprl.evaluation.evaluate import evaluate_run, run_table

    prepare_process(fresh.seed)
    evaluation = evaluate_run(run, **vars(fresh))
    _keep(evaluation.table, out)
    print_tables(run_table(evaluation))
    say(f"Weights: {evaluation.run.weights_from}")
    tell_files(out)


def visits(
    run: Path, /, *, fresh: FreshFlags = _TWENTY, figure: Path | None = None, random: bool = False
) -> None:
    """Lets all replicas of a run play fresh worlds, and prints how far agents keep to cells of their own.

    Args:
        run: the run's directory, or its results; of one that has not ended the newest checkpoint plays.
        figure: a PNG to be: a map for each agent of where it spends its time, in the first of the replicas.
        random: draw random agents in the same worlds instead.
    """
    make_importable(fresh.allow)
    if random and figure is None:
        raise ValueError("--random says who is drawn; allowed: with --figure FILE.png")
    check_files(figure=figure)
    check_runs(run)

    from cprl.evaluation.territory import draw_visits, territory_of, territory_table

    prepare_process(fresh.seed)
    found = territory_of(run, **vars(fresh))
    print_tables(territory_table(found))
    say(f"Weights: {found.run.weights_from}")
    policy: Policy = "random" if random else "trained"
    tell_files(None, figure, lambda path: draw_visits(found, path, policy=policy))


def crossplay(
    runs: tuple[str, ...],
    /,
    *,
    fresh: FreshFlags = _TWENTY,
    diagonal: Diagonal = "self",
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Lets agents of each run play among those of each other run, and prints how all fare.

    Args:
        runs: directories of runs of the same game, or their results; NAME=PATH gives one another name.
        diagonal: whom a run's agents meet there: "self", those they were trained with, or "cross_seed", those
            of the run's next replica.
        out: a parquet file to be, with every episode.
        figure: a PNG to be: what focal agents gain, and what it costs the background agents.
    """
    named = _named_runs(runs, fresh, out, figure)

    from cprl.evaluation.cross_play import agents_table, draw_gains, gains_tables, heading, matrices
    from cprl.evaluation.cross_play import crossplay as play_each_other

    prepare_process(fresh.seed)
    played = play_each_other(named, diagonal=diagonal, **vars(fresh))
    _keep(played.table, out)
    say(heading(played))
    print_tables(*matrices(played), *gains_tables(played), agents_table(played))
    tell_files(out, figure, lambda path: draw_gains(played, path))


def schelling(
    board: str,
    /,
    *,
    restrained: str = "sustainable",
    greedy: str = "greedy",
    variant: Variant = "published",
    episodes: int = 5,
    replicas: int = 8,
    seed: int = SEED,
    out: Path | None = None,
    figure: Path | None = None,
    allow: Allow = (),
) -> None:
    """Lets restrained and greedy agents play in all mixes, and prints which social dilemma they are in.

    Args:
        board: commons, two_complex, single_complex or single_basic; or the directory of a run, whose game it
            is then; or a file with a drawing.
        restrained: who plays restrained: random, greedy, sustainable, territorial, aggressive or pacifist, or
            the directory of a run, whose agents play.
        greedy: who plays greedy, likewise.
        variant: of the boards with a name: published, as_run or, of two_complex, as_run_10_april; see
            docs/game.md.
        episodes: of each replica and choice of restrained agents; with N agents these are N (N - 1) + 2.
        replicas: of runs, their replicas from 0 on; of scripted agents, independent groups of episodes.
        seed: of the worlds and all chance; the same one gives the same numbers.
        out: a parquet file to be, with every episode.
        figure: a PNG to be: the Schelling diagram.
        allow: code of your own, module:Class, that a run may import; see docs/experiments.md.
    """
    make_importable(allow)
    check_files(out, figure)
    check_board(board)

    from cprl.evaluation.populations import board_named
    from cprl.evaluation.schelling import draw_schelling, schelling_tables
    from cprl.evaluation.schelling import schelling as play_all_mixes

    prepare_process(seed)
    game, run = board_named(board, variant, allow=allow)
    found = play_all_mixes(
        game if run is None else run,
        restrained=restrained,
        greedy=greedy,
        episodes=episodes,
        replicas=replicas,
        seed=seed,
        allow=allow,
    )
    _keep(found.table, out)
    print_tables(*schelling_tables(found))
    tell_files(out, figure, lambda path: draw_schelling(found, path))


def egta(
    runs: tuple[str, ...],
    /,
    *,
    fresh: FreshFlags = _FIVE,
    pairwise: bool = False,
    resamples: int = EGTA_RESAMPLES,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Lets agents of runs play in all compositions, and prints which runs last: equilibria, alpha-rank,
    replicator dynamics (extra "theory").

    Args:
        runs: directories of runs of the same game, or their results; NAME=PATH gives one another name.
        pairwise: play one agent of each run among those of each other, as `cprl crossplay` does: cheaper,
            and a reduction where there are more than two agents.
        resamples: of the replicas, for intervals.
        out: a parquet file to be, with every episode.
        figure: a PNG to be: the dynamics, and the shares by alpha-rank.
    """
    named = _named_runs(runs, fresh, out, figure)

    from cprl.evaluation.cross_play import crossplay
    from cprl.evaluation.egta import analyse, draw_egta, egta_heading, egta_tables
    from cprl.evaluation.empirical_game import pairwise_game, play_empirical_game
    from cprl.theory.solutions import check_extras

    check_extras()
    prepare_process(fresh.seed)
    how = vars(fresh)
    game = pairwise_game(crossplay(named, **how)) if pairwise else play_empirical_game(named, **how)
    _keep(lambda: game.episodes_table, out)
    found = analyse(game, resamples=resamples)
    say(egta_heading(game))
    print_tables(*egta_tables(found))
    tell_files(out, figure, lambda path: draw_egta(found, path))


def scenarios(
    run: Path,
    /,
    *,
    scenarios: tuple[str, ...] = (),
    fresh: FreshFlags = _FIVE,
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Lets a run's agents play among agents that they never met, and prints how they fare beside random and
    greedy agents in their places.

    Args:
        run: the run's directory, or its results; of one that has not ended the newest checkpoint plays.
        scenarios: their names, e.g. minority_among_greedy; by default all of the run's game.
        out: a parquet file to be, with every episode.
        figure: a PNG to be: the returns in each scenario.
    """
    make_importable(fresh.allow)
    check_files(out, figure)
    check_runs(run)

    from cprl.evaluation.scenarios import draw_scenarios, heading, run_scenarios, scenario_tables

    prepare_process(fresh.seed)
    scores = run_scenarios(run, scenarios=scenarios, **vars(fresh))
    _keep(scores.table, out)
    say(heading(scores))
    print_tables(*scenario_tables(scores))
    say(f"Weights: {scores.run.weights_from}")
    tell_files(out, figure, lambda path: draw_scenarios(scores, path))


def exploit(
    run: Path,
    /,
    *,
    agents: tuple[int, ...] = (0,),
    algorithms: tuple[str, ...] = (),
    seeds: int = 3,
    training_episodes: int | None = None,
    replicas: int | None = None,
    episodes: int = 20,
    seed: int = SEED,
    device: str = "cpu",
    out: Path | None = None,
    jobs: int | None = None,
    dry_run: bool = False,
    allow: Allow = (),
) -> None:
    """Trains best responses to the agents of a run, and prints what they gain: how exploitable the run is.

    May be stopped; the same line continues, and plays again what is trained.

    Args:
        run: the directory of a run that has ended, or its results.
        agents: indices of the agents that are replaced, one at a time; each costs as many trainings.
        algorithms: what responses learn by: own, the algorithm of the replaced agent, DQN, PPO; by default
            own and PPO, or DQN if that is PPO; see docs/exploitability.md.
        seeds: trainings by each algorithm.
        training_episodes: of each; by default a quarter of those of the run.
        replicas: how many of the run's replicas are responded to, the first ones; by default all.
        episodes: fresh episodes of each replica to choose a response by, and as many to tell its gain by.
        seed: of the worlds of the latter; the former have the next one.
        device: where responses learn, e.g. cpu or cuda:0.
        out: the directory of trainings and results; by default exploit/NAME.
        jobs: processes that train at the same time, one for each place and algorithm.
        dry_run: list all trainings and their states; run and write nothing.
        allow: code of your own, module:Class, that the run may import; see docs/experiments.md.
    """
    make_importable(allow)
    check_runs(run)

    from cprl.evaluation.exploit import TABLE, measure, plan_responses
    from cprl.evaluation.responses import exploitability_tables
    from cprl.studies.study import directory_of

    prepare_process(seed)
    plan = plan_responses(
        run,
        agents=agents,
        algorithms=algorithms,
        seeds=seeds,
        training_episodes=training_episodes,
        replicas=replicas,
        episodes=episodes,
        seed=seed,
        device=device,
        allow=allow,
    )
    folder = directory_of(plan.study, plan.out if out is None else out)
    options = StudyOptions(out=folder, jobs=jobs, dry_run=dry_run, figures=False, allow=tuple(allow))
    executor_of(options)
    if not dry_run:
        plan.claim(folder)
    carry_out(plan.study, options, ["cprl", *sys.argv[1:]])
    if dry_run:
        return
    print_tables(*exploitability_tables(measure(plan, folder)))
    say(f"Episodes: {folder / TABLE}")


def _named_runs(
    runs: Sequence[str], fresh: Fresh, out: Path | None, figure: Path | None
) -> list[str] | dict[str, str]:
    """The runs that words name, once they and the files to be are checked."""
    make_importable(fresh.allow)
    check_files(out, figure)
    named = runs_by_name(runs)
    check_runs(*(named.values() if isinstance(named, dict) else named))
    return named


def _keep(table: "Callable[[], pa.Table]", out: Path | None) -> None:
    """Writes a table of episodes where `--out` says so."""
    if out is not None:
        from cprl.runs.episodes import write_table

        write_table(out, table())


def check_files(out: Path | None = None, figure: Path | None = None) -> None:
    """Checks what `--out` and `--figure` name before hours of work.

    Raises:
        FileExistsError: if a file exists.
    """
    if out is not None:
        refuse_to_write_over(out)
    if figure is not None:
        from cprl.terminal.style import check_picture

        check_picture(figure, "--figure")


def check_runs(*runs: Path | str) -> None:
    """Checks that runs are there, before what plays their agents is imported, which takes seconds."""
    for run in runs:
        read_recipe(Path(run))


def tell_files(
    out: Path | None, figure: Path | None = None, draw: Callable[[Path], Path] | None = None
) -> None:
    """Says where the episodes are, and draws the figure."""
    if out is not None:
        say(f"Episodes: {out}")
    if figure is not None and draw is not None:
        say(f"Figure: {draw(figure)}")


def runs_by_name(words: Sequence[str]) -> list[str] | dict[str, str]:
    """Runs as `crossplay` takes them: paths, or a table where one has a name, NAME=PATH."""
    pairs = []
    for word in words:
        name, equals, path = word.partition("=")
        is_named = (
            equals and name and "/" not in name and not Path(word).exists()
        )  # a path may have "=" itself
        pairs.append((name, path) if is_named else ("", word))
    if not any(name for name, _ in pairs):
        return [path for _, path in pairs]
    named = [(name or Path(path).resolve().name, path) for name, path in pairs]
    names = [name for name, _ in named]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name} names {names.count(name)} runs; allowed: each its own, NAME=PATH")
    return dict(named)


def print_tables(*tables: Table) -> None:
    """Prints tables; into a file or pipe as wide as they are."""
    shown = console(width=None if OUT.isatty() else 250)
    for table in tables:
        shown.print(table)
