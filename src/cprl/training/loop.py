"""train: a training from its first step to its last."""

from collections.abc import Mapping, Sequence
from typing import Any

from torch import nn
from torchrl.envs import EnvBase

from cprl.arguments import object_of
from cprl.callbacks import SavesTraining
from cprl.collectors import StepCollector
from cprl.finite import OnNan
from cprl.learners.base import Learner
from cprl.policies.assignment import AgentIndices
from cprl.policies.decisions import Decider
from cprl.training.training import MakeCollector, Training


def train(
    env: EnvBase,
    learners: Mapping[tuple[int, ...], Learner],
    *,
    episodes: int,
    others: Mapping[AgentIndices, nn.Module] | None = None,
    decisions: Decider | None = None,
    callbacks: Sequence[Any] = (),
    checkpointer: SavesTraining | None = None,
    update_every: int = 1,
    make_collector: MakeCollector = StepCollector,
    on_nan: OnNan = "stop",
) -> Training:
    """Plays so many episodes of every replica; each learner stores every turn and then updates.

    Args:
        env: see `Training`, also for all that is not said here.
        learners: by the indices of their agents.
        episodes: how many to play.
        others: the actors of the agents that do not learn.
        decisions: what all agents decide, where the game asks them.
        callbacks: called after each turn and each episode.
        checkpointer: where the training resumes from, and saves its state now and then.
        update_every: steps k after which each learner updates, then k times.
        make_collector: what plays.
        on_nan: "stop" or "continue".

    Returns:
        The training, which is over.

    Raises:
        ValueError: see `Training`; with a checkpointer also for what has no state to resume from.
        NotFiniteError: where a number is not finite, before a checkpoint holds it; see `cprl.finite`.
    """
    training = Training(
        env,
        learners,
        episodes=episodes,
        others=others,
        decisions=decisions,
        callbacks=callbacks,
        update_every=update_every,
        make_collector=make_collector,
        on_nan=on_nan,
    )
    if checkpointer is not None:
        object_of("checkpointer", checkpointer, SavesTraining, "None, or what has `restore` and `after_step`")
        training.state_dict()  # what cannot be saved is refused now, not when the first checkpoint is due
        checkpointer.restore(training)
    training.start()
    while not training.is_over:
        training.step()
        if checkpointer is not None:
            checkpointer.after_step(training)
    return training
