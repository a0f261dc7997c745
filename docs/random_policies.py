"""Random policies on the published boards beside the study's appendix A, as a Markdown table.

python docs/random_policies.py
"""

from statistics import fmean, stdev

import tyro

from cprl import CommonsEnv, presets
from cprl.measuring.playing import evaluate
from cprl.policies.actors import RandomActor
from cprl.policies.joint_policy import JointPolicy

APPENDIX_A = {
    "single_basic": (1, 32.47),
    "single_complex": (2, 59.53),
    "two_complex": (3, 92.57),
    "commons": (5, 264.53),
}


def main(*, episodes: int = 400, seed: int = 0) -> None:
    """Print a row for each board and variant.

    Args:
        episodes: played for each.
        seed: of the games and of the players.
    """
    print("| experiment | board | variant | return, published | return, ours | peacefulness, ours |")
    print("|---|---|---|---:|---:|---:|")
    for board, (experiment, published) in APPENDIX_A.items():
        for variant in ("as_run", "published"):
            game = presets.game(board, variant=variant)
            actors = [RandomActor(len(game.actions), seed=seed + agent) for agent in range(game.agents)]
            played = evaluate(CommonsEnv(game, episodes, seed=seed), JointPolicy(actors))
            returns = [float(episode.return_.sum()) for episode in played]
            peace = [episode.metrics["peacefulness"] for episode in played]
            ours, calm = (f"{fmean(x):.2f} ± {stdev(x) / episodes**0.5:.2f}" for x in (returns, peace))
            print(f"| {experiment} | {board} | {variant} | {published} | {ours} | {calm} |")


if __name__ == "__main__":
    tyro.cli(main)
