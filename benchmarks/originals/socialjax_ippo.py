"""How fast SocialJax' IPPO learns its harvest_open, and cprl's on a game like it, on one core.

    PYTHONPATH=path/to/SocialJax taskset -c 0 python benchmarks/originals/socialjax_ippo.py
    taskset -c 0 python benchmarks/originals/socialjax_ippo.py --of cprl [--network mlp]

The first line needs SocialJax and nothing of `cprl`, the second the reverse. Both have SocialJax' settings:
seven agents that share parameters and one reward, 256 worlds, 2 epochs, minibatches of 3,584 agent steps; but
rollouts are shorter, 8 turns and not 1,000, whose observations alone take 13 GB. SocialJax' network has three
convolutions of 32 channels, the first of 5 x 5 cells and the others of 3 x 3, and one trunk for policy and
value; those of cprl are 3 x 3 and two trunks, and there are three channels of input and not fifteen. `mlp` is
two layers of 64. Rates are env steps, turns of one world, in a second of the processor; compilation does not
count. SocialJax' loops over minibatches are written out, since XLA's loops over convolutions are very slow on
CPUs (jax issue 12868).
"""

import argparse
import os
import sys
import time
from collections.abc import Iterator
from statistics import median
from types import ModuleType
from typing import Any

from cprl.runs.schedule import Schedule

WORLDS = 256
AGENTS = 7
TURNS = 8
MINIBATCHES = 500
"""The minibatches of a rollout of 1,000 turns."""


def write_out_loops(jax: Any, shorter_than: int) -> None:
    scan = jax.lax.scan

    def written_out(body: Any, carried: Any, xs: Any = None, length: Any = None, **options: Any) -> Any:
        turns = int(length or len(jax.tree.leaves(xs)[0]))
        if turns >= shorter_than:
            return scan(body, carried, xs, turns, **options)
        outputs = []
        for turn in range(turns):
            carried, output = body(carried, jax.tree.map(lambda column, turn=turn: column[turn], xs))
            outputs.append(output)
        return carried, jax.tree.map(lambda *each: jax.numpy.stack(each), *outputs)

    jax.lax.scan = written_out


def socialjax_rates() -> Iterator[float]:
    """Yield the rates of first updates, with the start of worlds and network."""
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["JAX_PLATFORMS"] = "cpu"
    for name in ("wandb", "hydra"):  # not needed
        sys.modules[name] = ModuleType(name)
    sys.modules["wandb"].log = lambda metric: None  # type: ignore[attr-defined]
    import jax
    from algorithms.IPPO.ippo_cnn_harvest_open import make_train

    game = {"num_agents": AGENTS, "num_inner_steps": 1000, "shared_rewards": True, "cnn": True, "jit": True}
    ppo = {"LR": 5e-4, "GAMMA": 0.99, "GAE_LAMBDA": 0.95, "CLIP_EPS": 0.2, "ENT_COEF": 0.01, "VF_COEF": 0.5}
    ppo |= {"MAX_GRAD_NORM": 0.5, "REW_SHAPING_HORIZON": 2.5e6, "SHAPING_BEGIN": 1e6, "UPDATE_EPOCHS": 2}
    sizes = {"NUM_ENVS": WORLDS, "NUM_STEPS": TURNS, "NUM_MINIBATCHES": MINIBATCHES * TURNS // 1000}
    network = {"ACTIVATION": "relu", "ANNEAL_LR": True, "PARAMETER_SHARING": True}
    names = {"ENV_NAME": "harvest_common_open", "ENV_KWARGS": game, "TOTAL_TIMESTEPS": TURNS * WORLDS}
    write_out_loops(jax, TURNS)
    key = jax.random.PRNGKey(0)
    train = jax.jit(make_train(ppo | sizes | network | names)).lower(key).compile()
    while True:
        began = time.process_time()
        jax.block_until_ready(train(key))
        yield TURNS * WORLDS / (time.process_time() - began)


def cprl_rates(network: str) -> Iterator[float]:
    from cprl import CommonsEnv, presets
    from cprl.algorithms import IPPO, RolloutSettings
    from cprl.networks import MLP, Conv
    from cprl.population import Team
    from cprl.system.process import prepare_process
    from cprl.training.agents import Population
    from cprl.training.training import Training

    prepare_process(0)
    cells = (64, 64)
    chosen = Conv(channels=(32, 32, 32), hidden_cells=cells) if network == "conv" else MLP(hidden_cells=cells)
    minibatch = WORLDS * 1000 // MINIBATCHES
    sizes = {"rollout_steps": TURNS, "minibatch_size": minibatch, "epochs": 2}
    settings = RolloutSettings(gamma=0.99, learning_rate=5e-4, **sizes)
    ippo = IPPO(settings=settings, network=chosen, entropy_coeff=0.01)
    team = Team(ippo, agents=tuple(range(AGENTS)), reward="team", share_parameters=True)
    env = CommonsEnv(presets.game("socialjax/harvest_open-v1"), WORLDS, seed=0)
    population = Population(env, (team,), seed=0, worlds=WORLDS)
    training = Training(env, population.learners, Schedule(steps=2**60, worlds=WORLDS))
    for _ in range(TURNS + 2):  # compiles
        training.step()
    while True:
        began = time.process_time()
        for _ in range(TURNS):
            training.step()
        yield TURNS * WORLDS / (time.process_time() - began)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--of", choices=("socialjax", "cprl"), default="socialjax")
    parser.add_argument("--network", choices=("conv", "mlp"), default="conv")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    rates = socialjax_rates() if options.of == "socialjax" else cprl_rates(options.network)
    first = [next(rates) for _ in range(options.rounds)]
    each = ", ".join(f"{rate:,.1f}" for rate in first)
    print(f"{median(first):,.1f} env steps/s, {AGENTS * median(first):,.1f} agent steps/s ({each})")
