"""Who exploits whom? Each way's trained agents among those of each other, once a comparison has run.

python recipes/study/learners/cross_play.py studies/learners_two_complex
"""

from pathlib import Path

import tyro

import cprl
from cprl.commands.play_stored import Files
from cprl.commands.recipe import in_a_sentence
from cprl.evaluation import draw_gains
from cprl.runs.episodes import write_table
from cprl.studies.trials import trials_of


def main(
    comparison: Path, /, *, runs: Path | None = None, out: Path | None = None, episodes: int = 20
) -> None:
    """Plays the cross-play of a study's conditions: a focal agent of each among the agents of each other.

    Args:
        comparison: the study's directory.
        runs: the directory of its runs, by default the study's own.
        out: where cross_play.parquet and cross_play.png are written, by default the study's directory.
        episodes: of each replica with each focal agent.
    """
    study, out = cprl.studies.read_study(comparison), out or comparison
    table, figure = out / "cross_play.parquet", out / "cross_play.png"
    Files(out=(table,), figure=figure).check()
    out.mkdir(parents=True, exist_ok=True)
    trained = {own.condition.name: (runs or comparison / "runs") / own.name for own in trials_of(study)}
    played = cprl.crossplay(trained, cprl.Fresh(episodes=episodes))
    write_table(table, played)
    print(draw_gains(played, figure))


if __name__ == "__main__":
    with in_a_sentence("cross_play.py"):
        tyro.cli(main)
