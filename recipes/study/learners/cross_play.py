"""Who exploits whom? Each way's trained agents among those of each other, once a comparison has run.

python recipes/study/learners/cross_play.py studies/learners_two_complex
"""

from pathlib import Path

import tyro

import cprl
from cprl.commands.flags import ResultFiles
from cprl.commands.recipe_command import exit_with_message
from cprl.evaluation import draw_gains
from cprl.runs.episodes import write_table
from cprl.studies.trials import trials_of


def main(
    comparison: Path, /, *, runs: Path | None = None, out: Path | None = None, episodes: int = 20
) -> None:
    """Play the cross-play of a study's conditions: a focal agent of each among the agents of each other.

    Args:
        comparison: the study's directory.
        runs: the directory of its runs, by default the study's own.
        out: where cross_play.parquet and cross_play.png are written, by default the study's directory.
        episodes: of each replica with each focal agent.
    """
    study = cprl.studies.read_study(comparison)
    runs = runs or comparison / "runs"
    out = out or comparison
    table = out / "cross_play.parquet"
    figure = out / "cross_play.png"
    ResultFiles(out=(table,), figure=figure).check()
    out.mkdir(parents=True, exist_ok=True)
    trained = {trial.condition.name: runs / trial.name for trial in trials_of(study)}
    played = cprl.crossplay(trained, cprl.Fresh(episodes=episodes))
    write_table(table, played)
    print(draw_gains(played, figure))


if __name__ == "__main__":
    with exit_with_message("cross_play.py"):
        tyro.cli(main)
