"""`cprl egta`: which of several runs lasts where agents choose among them."""

from pathlib import Path

from cprl.arguments import EGTA_RESAMPLES, SEED
from cprl.commands.parts import check_files, check_runs, print_tables, runs_by_name, tell_files
from cprl.commands.recipe import Allow, make_importable
from cprl.system.output import say
from cprl.system.process import prepare_process


def egta(
    runs: tuple[str, ...],
    /,
    *,
    episodes: int = 5,
    pairwise: bool = False,
    resamples: int = EGTA_RESAMPLES,
    greedy: bool = False,
    seed: int = SEED,
    replicas: tuple[int, ...] = (),
    out: Path | None = None,
    figure: Path | None = None,
    allow: Allow = (),
) -> None:
    """Lets agents of runs play in all compositions, and prints which runs last: equilibria, alpha-rank,
    replicator dynamics (extra "theory").

    Args:
        runs: directories of runs of the same game, or their results; NAME=PATH gives one another name.
        episodes: of each replica and choice of who plays where.
        pairwise: play one agent of each run among those of each other, as `cprl crossplay` does: cheaper,
            and a reduction where there are more than two agents.
        resamples: of the replicas, for intervals.
        greedy: whether agents play what they hold best, without exploring or drawing.
        seed: of the worlds and all chance; the same one gives the same numbers.
        replicas: their numbers; by default all that every run has.
        out: a parquet file to be, with every episode.
        figure: a PNG to be: the dynamics, and the shares by alpha-rank.
        allow: code of your own, module:Class, that the run may import; see docs/experiments.md.
    """
    make_importable(allow)
    check_files(out, figure)
    named, chosen = runs_by_name(runs), list(replicas)
    check_runs(*(named.values() if isinstance(named, dict) else named))

    from cprl.evaluation.cross_play import crossplay
    from cprl.evaluation.egta import analyse, draw_egta, egta_heading, egta_tables
    from cprl.evaluation.empirical_game import pairwise_game, play_empirical_game
    from cprl.runs.labelled import write_table
    from cprl.theory.extras import check_extras

    check_extras()
    prepare_process(seed)
    if pairwise:
        game = pairwise_game(
            crossplay(named, episodes=episodes, greedy=greedy, seed=seed, replicas=chosen, allow=allow)
        )
    else:
        game = play_empirical_game(
            named, episodes=episodes, greedy=greedy, seed=seed, replicas=chosen, allow=allow
        )
    if out is not None:
        write_table(out, game.episodes_table)
    found = analyse(game, resamples=resamples)
    say(egta_heading(game))
    print_tables(*egta_tables(found))
    tell_files(out, figure, lambda path: draw_egta(found, path))
