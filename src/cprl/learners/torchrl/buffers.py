"""The state of stock replay buffers, in tensors, numbers and dicts."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer


def buffer_state(buffer: TensorDictReplayBuffer, generator: torch.Generator) -> dict[str, Any]:
    """The full state of a replay buffer, with the written transitions only: the state dict of
    `TensorDictReplayBuffer` includes all allocated memory."""
    kept = len(buffer)
    transitions = buffer.storage.get(slice(0, kept)) if kept else None
    if transitions is not None and kept < buffer.storage.max_size:
        transitions = transitions.clone()
    return {
        "transitions": {} if transitions is None else plain(transitions),
        "writer": dict(buffer.writer.state_dict()),
        "sampler": dict(buffer.sampler.state_dict()),
        "transforms": dict(buffer.transform.state_dict()),
        "generator": generator.get_state(),
    }


def load_buffer(buffer: TensorDictReplayBuffer, generator: torch.Generator, state: Mapping[str, Any]) -> None:
    """Fills an empty replay buffer from what `buffer_state` gave."""
    if state["transitions"]:
        transitions = nested(state["transitions"]).to(buffer.storage.device)
        buffer.storage.set(torch.arange(len(transitions)), transitions)
    buffer.writer.load_state_dict(state["writer"])
    buffer.sampler.load_state_dict(state["sampler"])
    buffer.transform.load_state_dict(state["transforms"])
    generator.set_state(state["generator"].cpu())


def plain(transitions: TensorDictBase) -> dict[str, Tensor]:
    """Entries by name, those of "next" as "next.reward" and so on."""
    return dict(transitions.flatten_keys(".").items())


def nested(entries: Mapping[str, Tensor]) -> TensorDict:
    """The inverse of `plain`: a TensorDict [transitions]."""
    size = [len(next(iter(entries.values())))]
    nested: TensorDict = TensorDict(dict(entries), size).unflatten_keys(".")
    return nested
