"""Learners of plain DQN, and its loss over one network, for tests of learners and engines."""

from dataclasses import replace

import numpy as np
import torch
from tensordict import TensorDict

from cprl import Game, Rules, algorithms, maps
from cprl.algorithms import DQN, DQNSettings, OffPolicy, OnPolicy
from cprl.learners.base import LearningAgents
from cprl.learners.replay import ReplayLearner
from cprl.learners.transitions import LaneTurn

MEADOW = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=12, freeze_steps=2),
)
"""A small board for two agents."""
KINDS = [
    kind
    for kind in map(vars(algorithms).get, algorithms.__all__)
    if issubclass(kind, OffPolicy | OnPolicy) and kind not in (OffPolicy, OnPolicy)
]
"""All algorithms whose lanes an engine updates."""


def make_learner(algorithm, spaces, *, engine="compiled", **who):
    return algorithm.make_learner(LearningAgents(spaces, **who), engine)


def learner_of_parts(kind, algorithm, spaces, *, parts=(), options=(), **who):
    """A learner of a kind, with parts of a `Method` in place of the algorithm's, and options of its kind."""
    method = replace(algorithm.method(spaces), **{"batching": None, **dict(parts)})
    return kind(LearningAgents(spaces, **who), method, **dict(options))


def dqn_learner(spaces, *, settings, kind=ReplayLearner, make_loss=None, engine=None, compile=None, **who):
    parts = {"batching": engine} if make_loss is None else {"make_loss": make_loss, "batching": engine}
    options = {} if compile is None else {"compile": compile}
    return learner_of_parts(kind, DQN(settings=settings), spaces, parts=parts, options=options, **who)


def dqn_loss(network, *, gamma):
    return DQN(settings=DQNSettings(gamma=gamma)).make_loss(network)


def played(learner, env, steps, seen=None):
    """The losses of a learner of all agents after each step in an environment, None without an update; the
    turns are added to `seen`."""
    moment, losses = env.reset(), []
    for _ in range(steps):
        moment["agents", "action"] = learner.actor.choose(moment["agents", "observation"])
        turn, moment = env.step_and_maybe_reset(moment)
        learner.store(turn)
        losses.append(learner.update())
        if turn["next", "done"].any():
            learner.end_episode(turn["next", "done"].flatten())
        if seen is not None:
            seen.append(turn)
    return losses


def transitions(observation, action, next_observation, reward, ends, **entries):
    """Transitions under TorchRL's default keys, of tensors or lists; `ends` are "done" and "terminated"."""
    after = {"observation": next_observation, "reward": reward, "done": ends, "terminated": ends}
    before = {"observation": observation, "action": action, **entries}
    size = [len(action)]
    made, made_after = (
        TensorDict({name: torch.as_tensor(entry) for name, entry in entries.items()}, size)
        for entries in (before, after)
    )
    return made.set("next", made_after)


def write(ring, transitions):
    """Writes a transition of every lane, [L], under TorchRL's default keys."""
    after = transitions["next"]
    flags = (after[name].flatten().numpy() for name in ("done", "terminated"))
    before = (transitions[name].numpy() for name in ("observation", "action"))
    ring.write(LaneTurn(*before, after["observation"].numpy(), after["reward"].squeeze(-1).numpy(), *flags))


def q_table(learner, lane):
    """The table of a lane of a `TabularLearner`, a row a state it has met: the bytes of all that it observed,
    the window, and of each action its value and its visits."""
    states, values, visits = learner.tables.of_lane(lane)
    size = np.prod(learner.spaces.observation_shape) * np.dtype(learner.spaces.observation_dtype).itemsize
    seen = np.ascontiguousarray(states[:, :size]).view(learner.spaces.observation_dtype)
    seen = seen.reshape(len(states), *learner.spaces.observation_shape)
    return {
        "state": [state.tobytes() for state in states],
        "observation": seen,
        "values": values,
        "visits": visits,
    }
