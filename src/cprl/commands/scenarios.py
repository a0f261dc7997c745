"""`cprl scenarios`: a stored run among agents that it never met."""

from pathlib import Path

from cprl.arguments import SEED
from cprl.commands.parts import check_files, check_runs, print_tables, tell_files
from cprl.commands.recipe import Allow, make_importable
from cprl.system.output import say
from cprl.system.process import prepare_process


def scenarios(
    run: Path,
    /,
    *,
    scenarios: tuple[str, ...] = (),
    episodes: int = 5,
    greedy: bool = False,
    seed: int = SEED,
    replicas: tuple[int, ...] = (),
    out: Path | None = None,
    figure: Path | None = None,
    allow: Allow = (),
) -> None:
    """Lets a run's agents play among agents that they never met, and prints how they fare beside random and
    greedy agents in their places.

    Args:
        run: the run's directory, or its results; of one that has not ended the newest checkpoint plays.
        scenarios: their names, e.g. minority_among_greedy; by default all of the run's game.
        episodes: of each replica in each placement.
        greedy: whether stored agents play what they hold best, without exploring or drawing.
        seed: of the worlds and all chance; the same one gives the same numbers.
        replicas: their numbers; by default all.
        out: a parquet file to be, with every episode.
        figure: a PNG to be: the returns in each scenario.
        allow: code of your own, module:Class, that the run may import; see docs/experiments.md.
    """
    make_importable(allow)
    check_files(out, figure)
    check_runs(run)

    from cprl.evaluation.scenarios import draw_scenarios, heading, run_scenarios, scenario_tables
    from cprl.runs.labelled import write_table

    prepare_process(seed)
    scores = run_scenarios(
        run,
        scenarios=scenarios,
        episodes=episodes,
        greedy=greedy,
        seed=seed,
        replicas=replicas,
        allow=allow,
    )
    if out is not None:
        write_table(out, scores.table())
    say(heading(scores))
    print_tables(*scenario_tables(scores))
    say(f"Weights: {scores.run.weights_from}")
    tell_files(out, figure, lambda path: draw_scenarios(scores, path))
