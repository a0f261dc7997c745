"""How to collect experience in several processes, by TorchRL's collectors: one seed, other first worlds.
Prints the shape of each batch, and how many apples were harvested in it."""

from functools import partial

from torchrl.collectors import MultiSyncCollector

from cprl import CommonsEnv, presets


def main() -> None:
    """Collect ten batches from two processes with eight worlds each."""
    game = presets.game("commons")
    # Without first_world all processes would play the same worlds.
    parts = [partial(CommonsEnv, game, worlds=8, seed=0, threads=1, first_world=first) for first in (0, 8)]
    policy = None  # plays at random; else a module, of which each worker has a copy
    collector = MultiSyncCollector(parts, policy, frames_per_batch=1600, total_frames=16_000)
    for batch in collector:
        print(batch.shape, batch["next", "agents", "harvest"].sum())
        # After an update of the networks: collector.update_policy_weights_()
    collector.shutdown()


if __name__ == "__main__":  # processes are spawned, since a forked one can hang, and import this file
    main()
