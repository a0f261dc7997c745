"""What one agent lived through, under TorchRL's default keys, so that any of its losses can read it."""

from tensordict import TensorDict, TensorDictBase

from cprl import keys


def transitions_of(agent: int, batch: TensorDictBase) -> TensorDict:
    """The transitions of one agent out of what a collector yields.

    Args:
        agent: its number.
        batch: entries of `cprl.keys` at the root and under "next", of any batch size.

    Returns:
        A flat TensorDict [transitions] of "observation" uint8 [.., 3, X, Y], "action" int64 [..] and "next":
        "observation", "reward" float32 [.., 1], "done", "terminated", "truncated" bool [.., 1].
        Turns that the agent spends out of play are transitions too, with the action that it chose.
    """
    before, after = batch.get(keys.AGENTS), batch.get("next")
    agents_after = after.get(keys.AGENTS)
    dim = len(batch.batch_size)
    following = TensorDict(
        {
            "observation": agents_after.get("observation").select(dim, agent),
            "reward": agents_after.get("reward").select(dim, agent),
            **{name: after.get(name) for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)},
        },
        batch_size=batch.batch_size,
    )
    return TensorDict(
        {
            "observation": before.get("observation").select(dim, agent),
            "action": before.get("action").select(dim, agent),
            "next": following,
        },
        batch_size=batch.batch_size,
    ).reshape(-1)
