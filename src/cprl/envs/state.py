"""The whole state of an environment and of its transforms, for checkpoints."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.parameter import is_lazy
from torchrl.envs import Compose, EnvBase, TransformedEnv

from cprl.envs.unwrap import base_env, commons_of


def env_state(env: EnvBase) -> dict[str, Any]:
    """All that the future of an environment depends on, besides the TensorDict that it is stepped with:
    tensors, numbers, lists and tables."""
    commons = commons_of(env)
    if commons is None:
        worlds = dict(base_env(env).state_dict())
    else:
        worlds = {name: _tensor(array) for name, array in commons.worlds.state().items()}
    return {"worlds": worlds, "transforms": _all_of_transforms(env)}


def load_env_state(env: EnvBase, state: Mapping[str, Any]) -> None:
    """Put an environment, made with the same arguments, where `env_state` found it."""
    commons = commons_of(env)
    if commons is None:
        base_env(env).load_state_dict(state["worlds"])
    else:
        commons.load({name: _array(name, tensor) for name, tensor in state["worlds"].items()})
    if isinstance(env, TransformedEnv):
        _load(env, dict(state["transforms"]))


_FRAMES: Final = "_cat_buffers"
"""In the name of what `torchrl.envs.CatFrames` keeps of the worlds themselves, their latest observations."""


def transforms_state(env: EnvBase) -> dict[str, Any]:
    """Return what the transforms have learned or been told, e.g. the statistics of a normalisation; nothing
    of the worlds themselves."""
    return {name: value for name, value in _all_of_transforms(env).items() if _FRAMES not in name}


def load_transforms_state(env: EnvBase, state: Mapping[str, Any]) -> None:
    """Give the transforms of an environment what those of another had; what they keep of its own worlds
    stays.
    """
    if isinstance(env, TransformedEnv):
        _load(env, {name: value for name, value in state.items() if _FRAMES not in name})


def _all_of_transforms(env: EnvBase) -> dict[str, Any]:
    """Also what transforms keep of the worlds, once these have been reset."""
    if not isinstance(env, TransformedEnv):
        return {}
    state = env.transform.state_dict(keep_vars=True)
    sound = {name: value for name, value in state.items() if not is_lazy(value)}
    return {name: value.detach() if isinstance(value, Tensor) else value for name, value in sound.items()}


def _load(env: TransformedEnv, state: dict[str, Any]) -> None:
    """Load a copy of the state of transforms; what they keep of the worlds may be missing."""
    transforms = env.transform if isinstance(env.transform, Compose) else [env.transform]
    kinds = ", ".join(type(transform).__name__ for transform in transforms)
    try:  # a copy, since some transforms keep the very tensors that they are given
        missing, unexpected = env.transform.load_state_dict(deepcopy(state), strict=False)
    except (KeyError, RuntimeError, TypeError) as error:
        raise ValueError(
            f"the transforms {kinds} refuse the state of the same transforms: {error}; allowed: transforms "
            "whose load_state_dict takes what their state_dict gives"
        ) from error
    wrong = sorted(name for name in (*missing, *unexpected) if _FRAMES not in name)
    if wrong:
        raise ValueError(
            f"the state of the transforms {kinds} lacks, or has beyond theirs, {', '.join(wrong)}; allowed: "
            "transforms whose load_state_dict takes what their state_dict gives"
        )


def carried_state(carried: TensorDictBase) -> dict[str, Any]:
    """Return the TensorDict that an environment is stepped with as nested tables of tensors."""
    table: dict[str, Any] = carried.to_dict()
    return table


def load_carried(fresh: TensorDictBase, state: Mapping[str, Any]) -> TensorDictBase:
    """Return the TensorDict of `carried_state`, in the form of what `env.reset()` gives."""
    return fresh.empty(recurse=True).update(dict(state))


def _array(name: str, tensor: Any) -> Any:
    """Return the array of a tensor that `_tensor` made of an array of this name."""
    if name in _UNSIGNED and isinstance(tensor, Tensor) and tensor.dtype == torch.int64:
        return tensor.numpy(force=True).view(np.uint64)
    return tensor


_UNSIGNED: Final = ("seed", "number")
"""The arrays of a state that are uint64."""


def _tensor(array: NDArray[Any]) -> Tensor:
    """Return the same bytes as a tensor; torch keeps unsigned numbers as signed ones."""
    return torch.from_numpy(array.view(np.int64) if array.dtype == np.uint64 else array)
