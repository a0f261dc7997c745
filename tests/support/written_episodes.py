"""Turns and episodes written out by hand."""

import numpy as np
import torch
from study_runs import an_episode as episode_of
from tensordict import TensorDict


def turn(worlds=1, agents=2, **entries):
    """A batch of one turn in which nothing happens but what the entries, nested lists [B, ...], say."""
    flags = {name: torch.zeros(worlds, 1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
    two = (worlds, agents, agents)
    happens = {
        "reward": torch.zeros(worlds, agents, 1),
        "harvest": torch.zeros(worlds, agents),
        "fired": torch.zeros(worlds, agents, dtype=torch.bool),
        "hit_by": torch.zeros(two, dtype=torch.bool),
        "tagged_by": torch.zeros(two, dtype=torch.bool),
    }
    world = {"stock": torch.ones(worlds, 1, dtype=torch.int64), **flags}
    in_play = torch.tensor(entries.pop("in_play", [[True] * agents] * worlds))
    had_ended = torch.tensor(entries.pop("had_ended", [[False]] * worlds))
    for name, value in entries.items():
        place = happens if name in happens else world
        place[name] = torch.tensor(value, dtype=place[name].dtype)
    return TensorDict(
        {
            "agents": TensorDict({"in_play": in_play}, [worlds, agents]),
            "done": had_ended,
            "next": TensorDict({**world, "agents": TensorDict(happens, [worlds, agents])}, [worlds]),
        },
        [worlds],
    )


def written_out(episode):
    """An episode as plain values, to compare."""
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else repr(value)
        for name, value in vars(episode).items()
    }


def all_written_out(tracker, batches):
    return [written_out(episode) for batch in batches for episode in tracker.add(batch)]


def an_episode(number=0, **metrics):
    """An episode of two agents, told apart by its number."""
    return episode_of(number, 0, 4.0, **metrics)
