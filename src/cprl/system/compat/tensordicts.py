"""Entries of TensorDicts, read and written past its checks."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.base import NO_DEFAULT

from cprl.system.libraries import require

require("tensordict", TensorDict, "_get_str", "_set_str", "_new_unsafe")
require("tensordict", TensorDict({}, []), "_tensordict")


def entry(tensordict: TensorDictBase, name: str) -> Any:
    """Return `tensordict.get(name)` ten times faster, without handling of nested keys.

    Raises:
        KeyError: if there is no such entry.
    """
    return tensordict._get_str(name, NO_DEFAULT)


class Views(dict[str, Any]):
    """The entries of a TensorDict as numpy arrays on the CPU, else as tensors; each is made when it is first
    read.

    Raises:
        KeyError: if there is no such entry.
    """

    def __init__(self, tensordict: TensorDictBase) -> None:
        self._tensordict = tensordict

    def __missing__(self, name: str) -> Any:
        tensor = self._tensordict._get_str(name, NO_DEFAULT)
        self[name] = view = tensor.numpy() if tensor.is_cpu else tensor
        return view


def put(tensordict: TensorDictBase, name: str, value: Any) -> None:
    """Do `tensordict.set(name, value)` without handling of keys or checks; the value must fit."""
    tensordict._set_str(name, value, validated=True, inplace=False, non_blocking=False)


def unchecked_tensordict(
    entries: dict[str, Any], batch_size: torch.Size, device: torch.device | None = None
) -> TensorDict:
    """Return `TensorDict(entries, batch_size, device=device)` without checks or copies; the entries must
    fit."""
    return TensorDict._new_unsafe(entries, batch_size=batch_size, device=device)


def put_all(tensordict: TensorDict, entries: Mapping[str, Any]) -> None:
    """Write several entries at once into a TensorDict of `unchecked_tensordict`, without checks."""
    tensordict._tensordict.update(entries)
