"""Choose how the lanes of a user's loss are updated: all together if that is possible, else one after the
other."""

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
"""The number of lanes in a trial update; what torch cannot vmap fails for two lanes too."""
_TRIAL_RULE: Final = UpdateRule(learning_rate=0.1)
"""The optimiser of a trial update."""


def choose_update(
    networks: Sequence[nn.Module],
    make_loss: MakeLoss,
    example: Callable[[int], TensorDict],
    *,
    declared: Update | None,
    sharing: int,
) -> Update:
    """Return how the lanes of a loss are updated.

    That is as declared, if the algorithm declares it. Else it is "vmapped", if torch can vmap the loss and
    the loss keeps no state between calls; or "list", with a warning.

    A loss is never "stacked" without a declaration. A stacked loss gets one batch of all lanes and may mix
    them, and a trial would not show a mixture that depends on the numbers of a batch.

    Args:
        networks: the networks of the lanes.
        make_loss: makes the loss of a network.
        example: makes a synthetic batch of a number of lanes, [L, b], in the shapes that the loss will read.
        declared: the update that the algorithm declares; None for none.
        sharing: the number of lanes that share a network.

    Raises:
        ValueError: if the loss is refused, see `check_loss`; or if it keeps state that lanes would share, and
            is declared to be updated for all lanes at once.
    """
    state_names = check_loss(make_loss(deepcopy(networks[0])), example(1)[0])
    obstacle = f"agents would share what the loss keeps of a call: {', '.join(state_names)}"
    if declared is not None:
        if state_names and declared != "list":
            raise ValueError(f'update is "{declared}", and {obstacle}; allowed: update = "list", or none')
        return declared
    if not state_names:
        trial = networks[:_TRIAL_LANES]
        batch = example(len(trial) * sharing)
        try:
            lane_networks = LaneNetworks(trial, make_loss, _TRIAL_RULE, update="vmapped", sharing=sharing)
            for _ in range(2):  # the first step may leave something that breaks the second
                lane_networks.learn(Draw.of(batch.clone()))
            return "vmapped"
        except Exception as error:  # a user's loss may raise anything
            obstacle = (str(error) or repr(error)).splitlines()[0]
    warnings.warn(
        f"agents are updated one after the other, which is many times slower: {obstacle}",
        RuntimeWarning,
        stacklevel=5,
    )
    return "list"
