"""How the lanes of a loss are updated, where its algorithm does not say, or is not of cprl."""

import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Final

from tensordict import TensorDict
from torch import nn

from cprl.learners.draw import Draw
from cprl.learners.networks import LaneNetworks, MakeLoss, Update
from cprl.learners.optimizers import UpdateRule
from cprl.learners.refusals import check_loss

_TRIAL_LANES: Final = 2
"""Networks that are tried: what torch does not vmap it refuses for two."""
_TRIAL_RULE: Final = UpdateRule(learning_rate=0.1)


def choose_update(
    networks: Sequence[nn.Module],
    make_loss: MakeLoss,
    example: Callable[[int], TensorDict],
    *,
    said: Update | None = None,
    sharing: int = 1,
) -> Update:
    """Return how the lanes of a loss are updated: as is said, or "vmapped", if torch vmaps the loss and it
    keeps nothing of a call, else "list", with a warning.

    A loss is never "stacked" unless its algorithm says so: over one batch of all lanes it may mix them, and a
    comparison on an example would not show what depends on the numbers of a batch.

    Args:
        example: makes a batch of so many lanes, [L, b], as the loss will read it.

    Raises:
        ValueError: if the loss is refused, see `check_loss`, or is said to be updated for all lanes at once
            and keeps something, which lanes would share.
    """
    kept = ", ".join(check_loss(make_loss(deepcopy(networks[0])), example(1)[0]))
    if said is not None:
        if kept and said != "list":
            raise ValueError(
                f'update is "{said}", and agents would share what the loss keeps of a call: {kept}; allowed: '
                'update = "list", or none'
            )
        return said
    reason = f"agents would share what the loss keeps of a call: {kept}"
    if not kept:
        tried = networks[:_TRIAL_LANES]
        batch = example(len(tried) * sharing)
        try:
            lanes = LaneNetworks(tried, make_loss, _TRIAL_RULE, update="vmapped", sharing=sharing)
            for _ in range(2):  # what the first step leaves may break the second
                lanes.learn(Draw.of(batch.clone()))
            return "vmapped"
        except Exception as error:  # a user's loss may raise anything
            reason = (str(error) or repr(error)).splitlines()[0]
    warnings.warn(
        f"agents are updated one after the other, which is many times slower: {reason}",
        RuntimeWarning,
        stacklevel=5,
    )
    return "list"
