"""Unlike neighbours on `commons`: two DQN agents, one PPO agent and one that follows a rule, in one training.

    python recipes/mixed.py                               4 replicas of 500 episodes
    python recipes/mixed.py --neighbour greedy

Copy this file and change who sits where: docs/algorithms.md lists who there is.
"""

from dataclasses import replace
from pathlib import Path

import tyro

from cprl import presets
from cprl.algorithms.dqn import DQN
from cprl.algorithms.on_policy import PPO
from cprl.experiment import conduct
from cprl.learners.settings import RolloutSettings
from cprl.policies.scripted import ScriptedPolicy
from cprl.population import Learner, Population, Scripted
from cprl.process import prepare_process
from cprl.runs.directory import start_run
from cprl.viewer.streams import check_watch


def main(
    *,
    neighbour: ScriptedPolicy = "sustainable",
    replicas: int = 4,
    episodes: int = 500,
    evaluation_episodes: int = 20,
    seed: int = 0,
    out: Path | None = None,
    resume: bool = False,
    watch: str = "file",
    compile: bool = True,
) -> Path:
    """Trains those who learn, evaluates everybody on fresh worlds, and returns the run's directory.

    Args:
        neighbour: the rule that agent 3 follows.
        replicas: independent repetitions of the whole training, side by side.
        episodes: how many each trains.
        evaluation_episodes: fresh episodes for each replica, and for the random policy.
        seed: of chance, weights, exploration and replay.
        out: the run's directory; by default a new one under runs/.
        resume: with the run in `out`, which was stopped; bit for bit as if it had not been.
        watch: "file", or live as well: "serve", "spawn", "connect ADDRESS"; "off" for no recording.
        compile: whether torch compiles the update; needs a C++ compiler, and is several times faster.
    """
    check_watch(watch)
    prepare_process(seed)
    game = presets.game("commons")
    settings = replace(presets.learner("commons"), learning_rate=1e-4, epsilon_decay_steps=100_000)
    dqn, ppo = Learner(DQN(settings=settings)), Learner(PPO(settings=RolloutSettings()))
    members = [dqn, dqn, ppo, Scripted(neighbour)]
    population = Population(game, members, replicas=replicas, seed=seed, compile=compile)
    recipe = {"replicas": replicas, "episodes": episodes, "seed": seed, "game": game}
    run = start_run(out, "mixed", {**recipe, "population": population.told()}, resume=resume)
    return conduct(
        run,
        population,
        episodes=episodes,
        title=f"commons, 2 DQN, 1 PPO, 1 {neighbour}, {replicas} replicas, {episodes} episodes",
        evaluation_episodes=evaluation_episodes,
        watch=watch,
    )


if __name__ == "__main__":
    tyro.cli(main)
