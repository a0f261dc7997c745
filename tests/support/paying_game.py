"""Institutions of somebody's own as a TorchRL transform, with entries like those of cprl's."""

import torch
from torchrl.data import Bounded, Unbounded
from torchrl.envs import Transform

from cprl.institutions import COUNT_NAMES


class Charges(Transform):
    """Who fires breaks a rule and pays 1.5, which the others share; each bite costs 0.25; 0.5 was decided.

    Needs `CommonsEnv`, B worlds of N agents.
    """

    def _entries(self, agents):
        fired, harvest = agents["fired"], agents["harvest"]
        fines = 1.5 * fired + 0.25 * harvest
        paid = 1.5 * fired.sum(-1, keepdim=True)
        transfers = (paid - 1.5 * fired) / max(1, fired.shape[-1] - 1)
        counts = torch.zeros(*fired.shape, len(COUNT_NAMES), dtype=torch.int32)
        counts[..., COUNT_NAMES.index("violations")] = fired
        counts[..., COUNT_NAMES.index("detections")] = fired
        return fines, transfers, fired.clone(), counts

    def _step(self, tensordict, following):
        agents = following["agents"]
        fines, transfers, violated, counts = self._entries(agents)
        counts = tensordict["agents", "counts"] + counts
        happened = {"fines": fines, "transfers": transfers, "violated": violated}
        agents.update({**happened, "counts": counts})
        agents["reward"] = agents["reward"] - fines[..., None] + transfers[..., None]
        following["in_force"] = torch.full((*following.batch_size, 1), 0.5)
        return following

    def _reset(self, tensordict, reset):
        agents = reset["agents"]
        size = agents["in_play"].shape
        counts = torch.zeros(*size, len(COUNT_NAMES), dtype=torch.int32)
        none = torch.zeros(size)
        nothing = {"fines": none, "transfers": none.clone(), "violated": none.bool()}
        agents.update({**nothing, "counts": counts})
        reset["in_force"] = torch.full((*reset.batch_size, 1), 0.5)
        return reset

    def transform_observation_spec(self, observation_spec):
        spec = observation_spec["agents"]
        size = spec.shape
        spec["fines"] = Unbounded(shape=size, dtype=torch.float32)
        spec["transfers"] = Unbounded(shape=size, dtype=torch.float32)
        spec["violated"] = Bounded(0, 1, shape=size, dtype=torch.bool)
        spec["counts"] = Unbounded(shape=(*size, len(COUNT_NAMES)), dtype=torch.int32)
        observation_spec["in_force"] = Unbounded(shape=(*observation_spec.shape, 1), dtype=torch.float32)
        return observation_spec
