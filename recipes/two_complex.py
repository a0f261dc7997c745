"""Experiment 3 of the study: two independent DQN agents on `two_complex`. Do they share, or shoot?

    python recipes/two_complex.py                          8 replicas of 6000 episodes

Copy this file and change it: another map, rule, network or loss is one line.
"""

from dataclasses import replace
from pathlib import Path

import tyro

from cprl import presets
from cprl.algorithms.dqn import DQN
from cprl.experiment import conduct
from cprl.population import Learner, Population
from cprl.process import prepare_process
from cprl.runs.directory import start_run
from cprl.viewer.streams import check_watch


def main(
    *,
    replicas: int = 8,
    episodes: int = 6000,
    variant: presets.Variant = "published",
    beam: bool = True,
    evaluation_episodes: int = 20,
    update_every: int = 1,
    seed: int = 0,
    out: Path | None = None,
    resume: bool = False,
    watch: str = "file",
    compile: bool = True,
) -> Path:
    """Trains the agents of all replicas, evaluates them on fresh worlds, and returns the run's directory.

    Args:
        replicas: independent repetitions of the whole training, side by side.
        episodes: how many each trains.
        variant: the rules and the learner as the study is written, or as it was run.
        beam: whether agents have the beam; without it nobody is tagged.
        evaluation_episodes: fresh episodes for each replica, with epsilon 0.05, and for the random policy.
        update_every: environment steps k after which agents learn, then k times.
        seed: of chance, weights, exploration and replay.
        out: the run's directory; by default a new one under runs/.
        resume: with the run in `out`, which was stopped; bit for bit as if it had not been.
        watch: "file", or live as well: "serve", "spawn", "connect ADDRESS"; "off" for no recording.
        compile: whether torch compiles the update; needs a C++ compiler, and is several times faster.
    """
    check_watch(watch)
    prepare_process(seed)
    game = presets.game("two_complex", variant=variant)
    game = replace(game, rules=replace(game.rules, may_fire=beam))
    settings = presets.learner("two_complex", variant=variant)
    learner = Learner(DQN(settings=settings))
    population = Population(game, [learner] * 2, replicas=replicas, seed=seed, compile=compile)
    recipe = {
        "replicas": replicas,
        "episodes": episodes,
        "variant": variant,
        "learn_every": update_every,
        "seed": seed,
        "game": game,
        "learner": settings,
        "population": population.told(),
    }
    name = "two_complex" if beam else "two_complex_no_beam"
    run = start_run(out, name, recipe, resume=resume)
    return conduct(
        run,
        population,
        episodes=episodes,
        title=f"{name}, {variant} rules, {replicas} replicas, {episodes} episodes",
        evaluation_episodes=evaluation_episodes,
        update_every=update_every,
        watch=watch,
    )


if __name__ == "__main__":
    tyro.cli(main)
