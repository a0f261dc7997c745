"""What is called while a training runs."""

from collections.abc import Sequence
from typing import Any, Final, Protocol, runtime_checkable

from tensordict import TensorDictBase

from cprl.arguments import objects
from cprl.checks import shown
from cprl.measuring.episodes import Episode


@runtime_checkable
class SavesTraining(Protocol):
    """What saves the state of a training, as `cprl.runs.Checkpointer` does."""

    def restore(self, training: Any) -> None:
        """Puts a new training where the last one was."""

    def after_step(self, training: Any) -> None:
        """Saves the state, if it is time to."""


class Callback(Protocol):
    """What is called while a training runs; each method may be missing.

    With `state_dict` and `load_state_dict` its state is part of the training's checkpoints.
    """

    def on_start(self, training: Any) -> None:
        """The `Training` is about to take its first step, or the first after a checkpoint."""

    def on_step(self, batch: TensorDictBase) -> None:
        """One turn of every world, as the collector yields it, [R]."""

    def on_episode(self, episode: Episode, learning: dict[str, float]) -> None:
        """An episode has ended; what was learned in it: `agent_0/loss`, `agent_0/epsilon`, ...

        A number that is written into `learning` under a name of one's own is logged with the others, by the
        loggers and the viewer of a run, and by callbacks that come later in a `Training`.
        """


HOOKS: Final = ("on_start", "on_step", "on_episode")


def check_callbacks(callbacks: Sequence[Any]) -> tuple[Any, ...]:
    """The callbacks; refuses one that nothing would call."""
    found = objects("callbacks", callbacks, object, "callbacks")
    for callback in found:
        if not any(hasattr(callback, hook) for hook in HOOKS):
            raise ValueError(
                f"the callback {shown(callback)} has none of the methods {', '.join(HOOKS)}: nothing would "
                "call it"
            )
    return found
