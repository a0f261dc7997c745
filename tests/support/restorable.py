"""That an environment, put where another one was, plays on as that one does."""

from itertools import chain

import torch

from cprl.envs.env_state import env_state, load_env_state


def played(env, carried, steps=40):
    """So many steps of random actions, rewards included, and what is carried after each."""
    found = []
    for _ in range(steps):
        step, carried = env.step_and_maybe_reset(env.rand_action(carried.clone()))
        found.append((step["next"].clone(), carried.clone()))
    return found


def assert_restorable(make):
    """`make` makes the environment, always with the same arguments; a game of the user's own may keep
    something beside its `state_dict`."""
    first, second = make(), make()
    carried = played(first, first.reset())[-1][1]
    fresh = second.reset()
    load_env_state(second, env_state(first))
    copied = fresh.empty(recurse=True).update(carried.to_dict())
    torch.manual_seed(1)
    expected = played(first, carried)
    torch.manual_seed(1)
    for one, other in zip(chain(*played(second, copied)), chain(*expected), strict=True):
        mine, theirs = (dict(moment.items(True, True)) for moment in (one, other))
        assert mine.keys() == theirs.keys()
        for name, value in mine.items():
            assert torch.equal(torch.nan_to_num(value), torch.nan_to_num(theirs[name])), name
