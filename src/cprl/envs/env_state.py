"""Save and restore the state of an environment and of its transforms, for checkpoints."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.parameter import is_lazy
from torchrl.envs import Compose, EnvBase, TransformedEnv

from cprl.envs.unwrap import base_env, commons_of


def env_state(env: EnvBase) -> dict[str, Any]:
    """Return everything that decides how an environment goes on, apart from the TensorDict that it is stepped
    with: the worlds and the transforms, as tensors, numbers, lists and dicts."""
    commons = commons_of(env)
    if commons is None:
        worlds = dict(base_env(env).state_dict())
    else:
        worlds = {name: _tensor_of(array) for name, array in commons.worlds.state().items()}
    return {"worlds": worlds, "transforms": _complete_transforms_state(env)}


def load_env_state(env: EnvBase, state: Mapping[str, Any]) -> None:
    """Restore a result of `env_state` in an environment that was made with the same arguments."""
    commons = commons_of(env)
    if commons is None:
        base_env(env).load_state_dict(state["worlds"])
    else:
        commons.load({name: _array_from(name, tensor) for name, tensor in state["worlds"].items()})
    if isinstance(env, TransformedEnv):
        _load_transforms(env, dict(state["transforms"]))


_FRAME_BUFFER: Final = "_cat_buffers"
"""The part of an entry's name by which one knows the buffers of `torchrl.envs.CatFrames`. They hold the
latest observations of the worlds, and exist only after the first reset."""


def transforms_state(env: EnvBase) -> dict[str, Any]:
    """Return what the transforms have learned or were given, e.g. the statistics of a normalisation, without
    the latest observations that they keep of the worlds."""
    state = _complete_transforms_state(env)
    return {name: value for name, value in state.items() if _FRAME_BUFFER not in name}


def load_transforms_state(env: EnvBase, state: Mapping[str, Any]) -> None:
    """Restore a result of `transforms_state` in the transforms of an environment; the observations that they
    keep of its worlds stay."""
    if isinstance(env, TransformedEnv):
        _load_transforms(env, {name: value for name, value in state.items() if _FRAME_BUFFER not in name})


def _complete_transforms_state(env: EnvBase) -> dict[str, Any]:
    """Return the state of the transforms, including the observations that they keep of the worlds."""
    if not isinstance(env, TransformedEnv):
        return {}
    state = env.transform.state_dict(keep_vars=True)
    initialised = {name: value for name, value in state.items() if not is_lazy(value)}
    return {
        name: value.detach() if isinstance(value, Tensor) else value for name, value in initialised.items()
    }


def _load_transforms(env: TransformedEnv, state: dict[str, Any]) -> None:
    """Load a state into the transforms; observations that they keep of the worlds may be missing in it."""
    transforms = env.transform if isinstance(env.transform, Compose) else [env.transform]
    kinds = ", ".join(type(transform).__name__ for transform in transforms)
    try:  # a copy, since some transforms keep and change the very tensors that they are given
        missing, unexpected = env.transform.load_state_dict(deepcopy(state), strict=False)
    except (KeyError, RuntimeError, TypeError) as error:
        raise ValueError(
            f"the transforms {kinds} refuse the state of the same transforms: {error}; allowed: transforms "
            "whose load_state_dict takes what their state_dict gives"
        ) from error
    unmatched = sorted(name for name in (*missing, *unexpected) if _FRAME_BUFFER not in name)
    if unmatched:
        raise ValueError(
            f"the state of the transforms {kinds} lacks, or has beyond theirs, {', '.join(unmatched)}; "
            "allowed: transforms whose load_state_dict takes what their state_dict gives"
        )


def _array_from(name: str, tensor: Any) -> Any:
    """Return the array from which `_tensor_of` made a tensor, by the name that the array has in a state."""
    if name in _UNSIGNED_ARRAYS and isinstance(tensor, Tensor) and tensor.dtype == torch.int64:
        return tensor.numpy(force=True).view(np.uint64)
    return tensor


_UNSIGNED_ARRAYS: Final = ("seed", "number")
"""The names of the arrays of a state that are uint64."""


def _tensor_of(array: NDArray[Any]) -> Tensor:
    """Return a tensor of the same bytes; uint64 becomes int64, which all of torch's functions know."""
    signed = array.view(np.int64) if array.dtype == np.uint64 else array
    return torch.from_numpy(signed)
