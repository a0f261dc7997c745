"""Hosted runs, whose people are imitated by random actions."""

import numpy as np
import pyarrow as pa
import torch

from cprl import CommonsEnv, Experiment, keys
from cprl.measuring.tracker import tracker_of
from cprl.population import Person, partners_in
from cprl.runs.played import write_played
from cprl.runs.states import start

PEOPLE_SEED = 5


def begun(folder, game, *, groups=3, bots=(), name="", seed=PEOPLE_SEED, session=None):
    """A hosted run whose round is not over; bots come after the people."""
    agents = (Person(),) * (game.agents - len(bots)) + tuple(bots)
    experiment = Experiment(
        name=name or folder.name, game=game, agents=agents, episodes=1, replicas=groups, seed=seed
    )
    return start(folder, experiment, partners_in(agents), session=session), experiment


def played(game, *, groups=3, seed=PEOPLE_SEED, chance=0):
    """The episodes of groups in which all act at random, and the rows of their turns."""
    env = CommonsEnv(game, worlds=groups, seed=seed)
    tracker = tracker_of(env)
    draw = np.random.default_rng(chance)
    size = groups, game.agents
    moment = env.reset()
    episodes = []
    rows = []
    for turn in range(1, game.rules.episode_steps + 1):
        moment[keys.ACTION] = torch.from_numpy(draw.integers(len(game.actions), size=size))
        if game.decisions:
            decisions = draw.integers(game.decisions, size=size) if turn == 1 else rows[0]["decision"]
            moment[keys.DECISION] = torch.from_numpy(decisions.reshape(size))
        batch, moment = env.lean_step(moment, resets=False)
        episodes += tracker.add(batch)
        entries = {
            "turn": np.full(size, turn, np.int32),
            "group": np.broadcast_to(np.arange(groups, dtype=np.int16)[:, None], size),
            "agent": np.broadcast_to(np.arange(game.agents, dtype=np.int16), size),
            "action": batch[keys.ACTION].numpy().astype(np.int8),
        }
        if game.decisions:
            entries["decision"] = batch[keys.DECISION].numpy().astype(np.int8)
        rows.append({column: values.reshape(-1) for column, values in entries.items()})
        if len(episodes) == groups:
            break
    return episodes, pa.concat_tables([pa.table(row) for row in rows])


def hosted(folder, game, *, turns=True, chance=0, **how):
    """A finished hosted run."""
    run, experiment = begun(folder, game, **how)
    episodes, rows = played(experiment.game, groups=experiment.replicas, seed=experiment.seed, chance=chance)
    write_played(run, episodes, **({"turns": rows} if turns else {}))
    return run
