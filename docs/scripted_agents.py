"""The table of scripted agents in docs/algorithms.md: a whole population of each scripted policy on a board.

python docs/scripted_agents.py --board commons --episodes 20
"""

from statistics import fmean

import tyro

from cprl import CommonsEnv, presets
from cprl.measuring.playing import evaluate, mean_return
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.scripted import SCRIPTED_POLICIES, Plan, ScriptedActor


def main(*, board: presets.Board = "commons", episodes: int = 20, seed: int = 0) -> None:
    """Print, for each policy, means over episodes; the return with its standard error."""
    game = presets.game(board)
    everyone = tuple(range(game.agents))
    print("| policy | return of all | steps | apples left | shots | tagged |\n|---|---:|---:|---:|---:|---:|")
    for policy in SCRIPTED_POLICIES:
        seeds = [(seed, agent) for agent in everyone]
        actor = ScriptedActor(Plan(policy), game, seeds=seeds, agents=len(everyone), worlds=episodes)
        played = evaluate(CommonsEnv(game, episodes, seed=seed), JointPolicy({everyone: actor}))
        return_, error = mean_return(played)
        numbers = [
            [float(episode.steps), float(episode.stock_left), episode.shots.sum(), episode.tagged.sum()]
            for episode in played
        ]
        means = " | ".join(f"{fmean(column):.1f}" for column in zip(*numbers, strict=True))
        print(f"| {policy} | {return_:.1f} ± {error:.1f} | {means} |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
