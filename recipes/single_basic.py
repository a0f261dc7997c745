"""Experiment 1 of the study: one DQN agent alone on `single_basic`. Does it learn not to strip the board?

    python recipes/single_basic.py --watch serve                     the published schedule, 6000 episodes
    python recipes/single_basic.py --schedule short --watch serve    some four minutes, live in the browser

Copy this file and change it: another map, rule, network or loss is one line.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
import tyro

from cprl import CommonsEnv, presets
from cprl.acting import RandomActor, Seats
from cprl.learning import DQNLearner
from cprl.measuring.evaluate import evaluate
from cprl.recording import (
    BestWeights,
    EpisodeTable,
    ProgressBar,
    Watch,
    restore_weights,
    save_weights,
    start_run,
    summarise,
    training_curve,
)
from cprl.train import train

PUBLISHED_LINE = ".venv/bin/python recipes/single_basic.py --watch serve"
SHORT = {"epsilon_decay_steps": 30_000, "batch_size": 64, "learning_rate": 3e-4, "target_every_episodes": 1}
"""What the short schedule changes, besides the number of episodes: it has to learn from 1/50 of the steps."""


def main(
    *,
    schedule: Literal["published", "short"] = "published",
    variant: presets.Variant = "published",
    episodes: int | None = None,
    evaluation_episodes: int = 100,
    seed: int = 0,
    out: Path | None = None,
    watch: Literal["file", "serve"] = "file",
) -> Path:
    """Trains the agent, evaluates it on fresh worlds, and returns the run's directory.

    Args:
        schedule: the published one, or a short one with the numbers of `SHORT`.
        variant: the rules and the learner as the study is written, or as it was run.
        episodes: how many to train; by default the schedule's, 6000 or 120.
        evaluation_episodes: fresh episodes for the trained and for the random policy.
        seed: of chance, weights, exploration and replay.
        out: the run's directory; by default a new one under runs/.
        watch: record to a file, or serve the recording live on 127.0.0.1 as well.
    """
    game = presets.game("single_basic", variant=variant)
    settings = presets.learner("single_basic", variant=variant)
    if schedule == "short":
        settings = replace(settings, **SHORT)
    episodes = episodes or (120 if schedule == "short" else 6000)
    title = f"single_basic, {variant} rules, {schedule} schedule, {episodes} episodes"
    arguments = {"schedule": schedule, "variant": variant, "episodes": episodes, "seed": seed}

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    run = start_run(out, "single_basic", {**arguments, "game": game, "learner": settings})
    env, trial = CommonsEnv(game, seed=seed), CommonsEnv(game, 16, seed=seed + 1)
    learner = DQNLearner(
        game.observation_shape,
        len(game.actions),
        settings=settings,
        highest=game.observation.highest,
        seed=seed,
    )
    policy, networks = Seats([learner.actor]), {"agent_0": learner.network}
    with (
        Watch(run, env, title=title, episodes=episodes, recipe=arguments, serve=watch == "serve") as viewer,
        EpisodeTable(run / "episodes.parquet") as table,
        ProgressBar(game, episodes=episodes) as bar,
    ):
        best = BestWeights(run, networks, policy=policy, env=trial, logger=viewer.logger)
        train(env, {0: learner}, episodes=episodes, observers=[table, viewer, best, bar])
    save_weights(run, networks)

    fresh = CommonsEnv(game, evaluation_episodes, seed=seed + 2)
    played = {"random": evaluate(fresh, Seats([RandomActor(len(game.actions), seed=seed)]))}
    played["greedy, last"] = evaluate(fresh, policy)
    if best.path:
        restore_weights(best.path, networks)
        played[f"greedy, best (episode {best.best_episode})"] = evaluate(fresh, policy)
    figure = training_curve(run, title=title, random=played["random"])
    summarise(run, title=title, played=played, figure=figure)
    if schedule == "short":
        print(f"This was a shortened schedule. The published one: {PUBLISHED_LINE}")
    return run


if __name__ == "__main__":
    tyro.cli(main)
