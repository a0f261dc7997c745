"""TorchRL's own collector, with which trainings are compared."""

from copy import deepcopy

from torchrl.collectors import Collector


def stock_collector(env, policy, *, steps=1):
    """Yields [B, steps]; agents explore in all of these steps with the epsilon of the first."""
    before = deepcopy(policy.state_dict())
    collector = Collector(
        env,
        policy,
        frames_per_batch=env.batch_size.numel() * steps,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    policy.load_state_dict(before)  # the collector called it once, which consumed random numbers
    return collector
