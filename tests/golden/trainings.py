"""Short trainings of every algorithm.

python tests/golden/trainings.py FAMILY FOLDER               writes to found.json what the trainings gave
python tests/golden/trainings.py FAMILY compiled FOLDER      ... how far compiled ones end from eager ones
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from golden import OWN_ALGORITHMS, columns

EPISODES, REPLICAS = 3, 2


def experiments() -> dict[str, dict[str, object]]:
    """The experiments by family and name."""
    from c51 import C51
    from cql import CQL
    from iql import IQL

    import cprl
    from cprl import Game, Observation, maps, presets
    from cprl.algorithms import (
        A2C,
        DQN,
        IPPO,
        LOLA,
        MADDPG,
        MAPPO,
        PPO,
        PR2,
        QMIX,
        SAC,
        VDN,
        DQNSettings,
        LOLASettings,
        Reinforce,
        RolloutSettings,
        Tabular,
        TabularSettings,
    )
    from cprl.institutions import Monitoring, Quota, Sanctioner, Tax, Vote
    from cprl.networks import GRU, LSTM, Conv
    from cprl.objectives.rewards import Exchange, InequityAversion, SocialValueOrientation
    from cprl.population import Learning, Scripted, Team

    cprl.trust(*OWN_ALGORITHMS)

    def board(variant: str) -> Game:
        rules = presets.game("commons", variant=variant).rules
        rules = replace(rules, window_rows=4, window_columns=5, episode_steps=40, freeze_steps=5)
        drawing = """
            >AA.A..A<
            .A#A..#AA
            ..A.AAAA.
        """
        return Game(map=maps.parse(drawing), rules=rules)

    def settings(variant: str, **changes: object) -> DQNSettings:
        quick = {
            "learning_rate": 1e-3,
            "epsilon_decay_steps": 60,
            "epsilon_hold_steps": 10,
            "buffer_size": 70,
        }
        return replace(presets.dqn_settings("commons", variant=variant), **{**quick, **changes})

    def of(*agents: object, variant: str = "as_run", game: Game | None = None) -> cprl.Experiment:
        return cprl.Experiment(
            name="golden",
            game=game or board(variant),
            agents=agents,
            episodes=EPISODES,
            replicas=REPLICAS,
            seed=11,
            evaluation_episodes=2,
            engine="eager",
        )

    def two(algorithm: object, variant: str = "as_run", **learning: object) -> cprl.Experiment:
        return of(*(Learning(algorithm, **learning),) * 2, variant=variant)

    def dqn(variant: str = "as_run", **changes: object) -> DQN:
        return DQN(settings=settings(variant, **changes))

    as_run, plain = settings("as_run"), settings("published")
    rollouts = RolloutSettings(rollout_steps=20, minibatch_size=10, learning_rate=0.02)  # so that it clips
    sequences = settings("published", sequence_steps=4)
    lola = LOLASettings(rollout_steps=20, critic_epochs=2)
    governed = replace(
        board("published"),
        institutions=(
            Quota(share=0.25, window_steps=10, fine=1.0),
            Monitoring(prob=0.5, cost=0.1, monitor="elected"),
            Vote(on=Tax(), choices=(0.0, 0.5)),
            Sanctioner(),
        ),
    )
    apart = replace(board("published"), observation=Observation(encoding="one_hot", agents_apart=True))
    networks = {"convolutional": Conv(channels=(4,), hidden_cells=(8,))}
    cells = {"gru": GRU(recurrent_cells=6), "lstm": LSTM(recurrent_cells=6)}
    return {
        "dqn": {
            "as run": two(dqn()),
            "published": two(dqn("published"), "published"),
            "10 April": two(DQN(settings=settings("as_run", gamma=0.999)), "as_run"),
            "double": two(DQN(settings=plain, double=True)),
            "tau": two(dqn("published", tau=0.05)),
            "n_steps": two(dqn("published", n_steps=3)),
            "every fourth step": two(dqn("published", steps_per_update=4, updates_per_step=2)),
            "keras_rmsprop, log_cosh": two(
                DQN(settings=settings("as_run", optimizer="keras_rmsprop"), loss_function="log_cosh")
            ),
            "adamw, smooth_l1": two(
                DQN(settings=settings("published", optimizer="adamw"), loss_function="smooth_l1")
            ),
            "sgd": two(dqn("published", optimizer="sgd")),
            "rmsprop": two(dqn("published", optimizer="rmsprop")),
            **{name: two(DQN(settings=plain, network=own)) for name, own in networks.items()},
            "learns every fourth step": replace(two(dqn()), update_every=4),
        },
        "off-policy": {
            "cql": two(CQL(settings=plain)),
            "c51": two(C51(settings=plain, atoms=11)),
            "sac": two(SAC(settings=plain)),
            "iql": two(IQL(settings=plain)),
            "pr2": two(PR2(settings=plain)),
            "tabular": two(Tabular(settings=TabularSettings(epsilon_decay_steps=60))),
        },
        "on-policy": {
            "ppo": two(PPO(settings=rollouts)),
            "a2c": two(A2C(settings=rollouts)),
            "reinforce": two(Reinforce(settings=rollouts)),
            **{f"ppo, {name}": two(PPO(settings=rollouts, network=own)) for name, own in networks.items()},
        },
        "recurrent": {
            f"{called}, {name}": two(kind(settings=own, network=cell))
            for called, kind, own in (("dqn", DQN, sequences), ("ppo", PPO, rollouts))
            for name, cell in cells.items()
        },
        "teams": {
            "vdn": of(Team(VDN(settings=plain), agents=(0, 1))),
            "qmix": of(Team(QMIX(settings=plain), agents=(0, 1))),
            "mappo": of(Team(MAPPO(settings=rollouts), agents=(0, 1))),
            "ippo": of(Team(IPPO(settings=rollouts), agents=(0, 1), reward="individual")),
            "maddpg": of(Team(MADDPG(settings=plain), agents=(0, 1), reward="individual")),
            "vdn, shared": of(Team(VDN(settings=plain), agents=(0, 1), share_parameters=True)),
            "mappo, shared": of(Team(MAPPO(settings=rollouts), agents=(0, 1), share_parameters=True)),
            "dqn, shared": of(Team(dqn(), agents=(0, 1), reward="individual", share_parameters=True)),
        },
        "opponent-aware": {
            "lola": of(Team(LOLA(settings=lola), agents=(0, 1), reward="individual")),
            "dice": of(Team(LOLA(settings=lola, estimator="dice"), agents=(0, 1), reward="individual")),
        },
        "mixed": {
            "dqn and ppo": of(Learning(dqn()), Learning(PPO(settings=rollouts))),
            "dqn and greedy": of(Learning(dqn()), Scripted("greedy")),
            "team reward": two(dqn(), reward="team"),
            "inequity aversion": two(dqn(), reward=InequityAversion(alpha=5, beta=0.05, smoothing=0.975)),
            "orientation": two(dqn(), reward=SocialValueOrientation(angle=0.8, weight=0.2)),
            "exchange": two(PPO(settings=rollouts), reward=Exchange(0.3)),
            "decisions": of(*(Learning(DQN(settings=plain)),) * 2, game=governed),
            "agents apart": of(*(Learning(DQN(settings=plain)),) * 2, game=apart),
            "as run in the published game": of(*(Learning(DQN(settings=as_run)),) * 2, variant="published"),
        },
    }


def weights(run: Path) -> dict[str, list[np.ndarray]]:
    """The weights of each lane."""
    import cprl

    return {
        lane: [value.detach().cpu().numpy() for value in network.state_dict().values()]
        for lane, network in cprl.load(run).networks.items()
    }


def sums(lane: list[np.ndarray]) -> list[float]:
    """The number of weights, the sum of their sizes, and one in which neighbours count unlike.

    They do not depend on names or on the order of layers, and may be compared with a tolerance.
    """
    sizes = [np.abs(layer.astype(np.float64).ravel()) for layer in lane]
    return [
        sum(map(len, sizes)),
        sum(float(size.sum()) for size in sizes),
        sum(float(size @ (np.arange(len(size)) % 7 + 1)) for size in sizes),
    ]


def tables(run: Path) -> dict[str, object]:
    """What a run says of its training: its table of episodes, and its evaluation."""
    import pyarrow.parquet as pq

    paths = {"episodes": "episodes.parquet"} | {
        name: f"evaluation/{name}.parquet" for name in ("trained", "random")
    }
    return {name: columns(pq.read_table(run / path)) for name, path in paths.items()}


def train(experiment: object, out: Path) -> dict[str, object]:
    """Train at once, and with a stop after the first episode; name what differs between the two."""
    import cprl

    quiet = {"watch": "off", "figures": False}
    whole = cprl.run(experiment, out / "whole", **quiet)
    cprl.run(replace(experiment, episodes=1), out / "halves", keep_checkpoint=True, **quiet)
    halves = cprl.run(experiment, out / "halves", resume=True, **quiet)
    found, again = tables(whole), tables(halves)
    learned, learned_again = weights(whole), weights(halves)
    differing = [name for name in found if found[name] != again[name]]
    differing += [
        lane for lane in learned if not all(map(np.array_equal, learned[lane], learned_again[lane]))
    ]
    return {
        **found,
        "weights": {lane: sums(layers) for lane, layers in learned.items()},
        "differs after a stop": differing,
    }


COMPILED = {
    "dqn": ("as run", "n_steps"),
    "off-policy": ("cql", "c51", "sac", "iql", "pr2"),
    "on-policy": ("ppo", "a2c", "reinforce"),
    "recurrent": ("dqn, gru",),
    "teams": ("vdn", "qmix", "mappo", "ippo", "maddpg"),
}
"""One training of each algorithm that can be compiled, by family."""


def distances(family: str, folder: Path) -> dict[str, float]:
    """The largest difference of a weight between a compiled and an eager training of one episode."""
    import cprl

    found = {}
    for name in COMPILED[family]:
        ends = []
        for engine in ("compiled", "eager"):
            experiment = replace(experiments()[family][name], engine=engine, episodes=1)
            out = folder / engine / name.replace(" ", "_").replace(",", "")
            cprl.run(experiment, out, watch="off", figures=False)
            ends.append(weights(out))
        compiled, eager = ends
        found[name] = max(
            float(np.abs(one - other).max())
            for lane, layers in compiled.items()
            for one, other in zip(layers, eager[lane], strict=True)
        )
    return found


def main(family: str, folder: Path) -> Mapping[str, object]:
    found = {}
    for name, experiment in experiments()[family].items():
        out = folder / name.replace(" ", "_").replace(",", "")
        out.mkdir(parents=True)
        found[f"{family}: {name}"] = train(experiment, out)
    return found


if __name__ == "__main__":
    measure = distances if "compiled" in sys.argv else main
    folder = Path(sys.argv[-1])
    (folder / "found.json").write_text(json.dumps(measure(sys.argv[1], folder)))
