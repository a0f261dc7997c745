"""A first run: one DQN agent alone on `single_basic` learns live in the viewer, in some four minutes.

    python recipes/first_run.py --watch serve

One agent, one world, out of TorchRL's own parts, to be read from top to bottom. Its schedule is its own: the
published one (recipes/single_basic.py, with 8 replicas) takes an hour.
Copy this file and change it: another map, rule, network or loss is one line.
"""

import logging
from dataclasses import replace
from pathlib import Path

import torch
import tyro

from cprl import CommonsEnv, presets
from cprl.learners.single import DQNLearner
from cprl.measuring.evaluate import evaluate
from cprl.policies.assignment import AgentPolicies
from cprl.policies.single import RandomActor
from cprl.runs.directory import start_run
from cprl.runs.episodes import EpisodeTable
from cprl.runs.weights import BestWeights, restore_weights, save_weights
from cprl.terminal.figures import training_curve
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import summarise
from cprl.training import train
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.streams import check_watch

PUBLISHED_LINE = ".venv/bin/python recipes/single_basic.py"
SHORT = {"epsilon_decay_steps": 30_000, "batch_size": 64, "learning_rate": 3e-4, "target_every_episodes": 1}
"""What differs from the published schedule, besides the number of episodes: it has to learn from 1/50 of the
steps."""


def main(
    *,
    variant: presets.Variant = "published",
    episodes: int = 120,
    evaluation_episodes: int = 100,
    seed: int = 0,
    out: Path | None = None,
    watch: str = "file",
) -> Path:
    """Trains the agent, evaluates it on fresh worlds, and returns the run's directory.

    Args:
        variant: the rules and the learner as the study is written, or as it was run.
        episodes: how many to train.
        evaluation_episodes: fresh episodes for the trained and for the random policy.
        seed: of chance, weights, exploration and replay.
        out: the run's directory; by default a new one under runs/.
        watch: "file", or live as well: "serve" on 127.0.0.1, "spawn" a viewer, "connect ADDRESS".
    """
    check_watch(watch, can_be_off=False)
    game = presets.game("single_basic", variant=variant)
    settings = replace(presets.learner("single_basic", variant=variant), **SHORT)
    title = f"single_basic, {variant} rules, short schedule, {episodes} episodes"
    arguments = {"variant": variant, "episodes": episodes, "seed": seed}

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    run = start_run(out, "first_run", {**arguments, "game": game, "learner": settings})
    env, trial = CommonsEnv(game, seed=seed), CommonsEnv(game, 16, seed=seed + 1)
    learner = DQNLearner(
        game.observation_shape,
        len(game.actions),
        settings=settings,
        highest=game.observation.highest,
        seed=seed,
    )
    policy, networks = AgentPolicies([learner.actor]), {"agent_0": learner.network}
    with (
        ViewerCallback(
            run,
            env,
            title=title,
            episodes=episodes,
            recipe=arguments,
            live=None if watch == "file" else watch,
        ) as viewer,
        EpisodeTable(run / "episodes.parquet") as table,
        ProgressBar(game, episodes=episodes) as bar,
    ):
        best = BestWeights(run, networks, policy=policy, env=trial, logger=viewer.logger)
        train(env, {0: learner}, episodes=episodes, callbacks=[table, viewer, best, bar])
    save_weights(run, networks)

    fresh = CommonsEnv(game, evaluation_episodes, seed=seed + 2)
    played = {"random": evaluate(fresh, AgentPolicies([RandomActor(len(game.actions), seed=seed)]))}
    played["greedy, last"] = evaluate(fresh, policy)
    if best.path:
        restore_weights(best.path, networks)
        played[f"greedy, best (episode {best.best_episode})"] = evaluate(fresh, policy)
    figure = training_curve(run, title=title, random=played["random"])
    summarise(run, title=title, played=played, figure=figure)
    print(f"This was a shortened schedule. The published one, with 8 replicas: {PUBLISHED_LINE}")
    return run


if __name__ == "__main__":
    tyro.cli(main)
