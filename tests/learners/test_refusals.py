"""What a learner cannot do as it is asked is refused by name before training."""

from dataclasses import dataclass, replace
from functools import partial

import pytest
import torch
from dqn_parts import MEADOW as GAME, changed, dqn_learner, dqn_loss, make_learner, played, watch_steps
from network_parts import REPLAY, ROLLOUTS, SPACES
from tensordict.nn import TensorDictModule
from torchrl.modules import QValueActor
from torchrl.objectives import ClipPPOLoss, DQNLoss, HardUpdate, KLPENPPOLoss, SoftUpdate, ValueEstimators

from cprl import CommonsEnv, Observation
from cprl.algorithms import A2C, DQN, PPO
from cprl.algorithms.base import policy

FLOATS = replace(SPACES, observation_dtype="float32", observation_scale=1.0)


def float_turn():
    """A turn of a world whose observations a transform has normalised."""
    turn = CommonsEnv(GAME, 1).rollout(1)[:, 0]
    for agents in (turn["agents"], turn["next", "agents"]):
        agents["observation"] = agents["observation"] / 255.0 - 0.5
    return turn


@pytest.mark.parametrize("kind", ["replay", "rollouts"])
def test_floats_are_not_rounded_into_bytes_and_are_learned_from_where_the_spaces_say_so(kind):
    def new(spaces):
        algorithm = DQN(settings=REPLAY) if kind == "replay" else PPO(settings=ROLLOUTS)
        return make_learner(algorithm, spaces, agents=(0, 1), replicas=1, engine="eager")

    with pytest.raises(ValueError, match=r"observations are .*float32.*Spaces.observation_dtype"):
        new(SPACES).store(float_turn())
    with pytest.raises(ValueError, match=r"observations are .*uint8"):
        new(FLOATS).store(CommonsEnv(GAME, 1).rollout(1)[:, 0])
    learner, turn = new(FLOATS), float_turn()
    learner.store(turn)
    if kind == "replay":
        kept = learner.memory.buffer.get(torch.zeros(2, 1, dtype=torch.int64))["observation"][:, 0]
    else:
        kept = learner.memory.rollout.fields["observation"][:, 0, 0]
    assert torch.equal(kept, turn["agents", "observation"][0])


@pytest.mark.parametrize("updater", [partial(SoftUpdate, tau=0.1), HardUpdate], ids=["soft", "hard"])
@pytest.mark.parametrize("update", [None, "list", "vmapped", "stacked"])
def test_a_target_updater_of_torchrls_that_would_have_no_effect_is_refused(updater, update):
    updaters = []

    def make_loss(network):
        loss = dqn_loss(network, gamma=0.9)
        updaters.append(updater(loss))
        return loss

    with pytest.raises(
        ValueError, match=r"a SoftUpdate or HardUpdate was built on the DQNLoss; .* set tau or"
    ):
        dqn_learner(SPACES, agents=(0,), replicas=1, settings=REPLAY, make_loss=make_loss, update=update)


def test_a_target_updater_on_the_loss_of_a_learner_is_refused():
    learner = make_learner(DQN(settings=REPLAY), SPACES, agents=(0,), replicas=1, engine="eager")
    with pytest.raises(ValueError, match=r"a SoftUpdate or HardUpdate .* DQNLoss; .* set tau or"):
        SoftUpdate(learner.lane_networks.losses[0].module, tau=0.1)


ONE = {"agents": (0,), "replicas": 1}


def rollout_learner(make_loss, *, engine="eager", settings=ROLLOUTS, **lanes):
    lanes = {"agents": (0, 1), "replicas": 1, **lanes}
    return make_learner(changed(PPO(settings=settings), make_loss=make_loss), SPACES, engine=engine, **lanes)


@pytest.mark.parametrize("algorithm", [PPO, A2C])
@pytest.mark.parametrize("estimator", [ValueEstimators.VTrace, ValueEstimators.TD0, ValueEstimators.TDLambda])
def test_advantages_by_another_estimator_than_that_of_the_loss_are_refused(algorithm, estimator):
    def make_loss(network):
        loss = algorithm(settings=ROLLOUTS).make_loss(network)
        how = {"actor_network": loss.actor_network} if estimator is ValueEstimators.VTrace else {}
        loss.make_value_estimator(estimator, **how)
        return loss

    for engine in ("eager", "torchrl"):
        with pytest.raises(ValueError, match=rf"has the value estimator {estimator}; allowed: GAE, "):
            rollout_learner(make_loss, engine=engine)


def test_gae_by_other_numbers_than_those_of_the_settings_is_refused():
    def make_loss(network, **how):
        loss = PPO(settings=ROLLOUTS).make_loss(network)
        loss.make_value_estimator(ValueEstimators.GAE, **how)
        return loss

    for wrong, message in (
        ({"gamma": 0.5, "lmbda": 0.95}, "gamma 0.5 .* gamma 0.995"),
        ({"gamma": 0.995, "lmbda": 0.5}, "lmbda 0.5 .* gae_lambda 0.95"),
    ):
        with pytest.raises(ValueError, match=message):
            rollout_learner(partial(make_loss, **wrong))
    rollout_learner(partial(make_loss, gamma=0.995, lmbda=0.95))


def test_a_loss_that_reads_steps_in_a_row_is_refused_with_replay():
    def make_loss(network):
        loss = dqn_loss(network, gamma=0.9)
        loss.make_value_estimator(ValueEstimators.TDLambda, gamma=0.9, lmbda=0.9)
        return loss

    with pytest.raises(ValueError, match=r"DQNLoss has the value estimator ValueEstimators.TDLambda"):
        dqn_learner(SPACES, agents=(0,), replicas=1, settings=REPLAY, make_loss=make_loss)


def kl_loss(network):

    critic = TensorDictModule(network["critic"], ["observation"], ["state_value"])
    return KLPENPPOLoss(policy(network["actor"]), critic, loss_critic_type="l2", dtarg=0.0001)


def test_ppo_with_a_kl_penalty_gets_the_old_logits_and_each_agent_a_penalty_of_its_own():
    with pytest.warns(RuntimeWarning, match="agents would share what the loss keeps of a call: beta"):
        learner = rollout_learner(kl_loss, replicas=2)
    assert learner.lane_networks.update == "list"
    assert not rollout_learner(PPO(settings=ROLLOUTS).make_loss).memory._reads_logits, (
        "others do not carry them"
    )
    seen = watch_steps(learner, lambda draw: draw.gather(draw.columns))
    losses = [loss for loss in played(learner, CommonsEnv(GAME, 2, seed=3), 24) if loss is not None]
    assert torch.isfinite(torch.stack(losses)).all()
    first = seen[0]
    chosen = first["logits"].log_softmax(-1).gather(-1, first["action"].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(chosen, first["action_log_prob"])
    penalties = [loss.module.beta for loss in learner.lane_networks.losses]
    assert all(float(beta) != 1.0 for beta in penalties), "it adapts"
    assert len({beta.data_ptr() for beta in penalties}) == 4
    assert all("beta" in kept["buffers"] for kept in learner.state_dict()["lane_networks"]["losses"])


class Demanding(ClipPPOLoss):
    """Reads what no rollout has."""

    def forward(self, tensordict):
        tensordict["weather"]
        return super().forward(tensordict)


def test_a_loss_that_reads_what_batches_do_not_have_is_refused_by_the_name_of_the_entry():
    def make_loss(network):
        made = PPO(settings=ROLLOUTS).make_loss(network)
        return Demanding(made.actor_network, made.critic_network)

    with pytest.raises(
        ValueError, match=r"the loss reads an entry that its batches do not have: .*weather.*advantage"
    ):
        rollout_learner(make_loss)


@pytest.mark.parametrize("name", ["scoreboard", "stock_gauge"])
def test_a_switch_of_observations_is_true_or_false(name):
    with pytest.raises(ValueError, match=rf"Observation\.{name} is 'planes'; allowed: True or False"):
        Observation(**{name: "planes"})


class OnlyTheCritics(ClipPPOLoss):
    """Returns the loss of the critic itself."""

    def forward(self, tensordict):
        return super().forward(tensordict)["loss_critic"]


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_a_loss_of_rollouts_that_returns_none_is_refused_too(engine):
    def make_loss(network):
        made = PPO(settings=ROLLOUTS).make_loss(network)
        return OnlyTheCritics(made.actor_network, made.critic_network)

    with pytest.raises(ValueError, match="the loss test_refusals:OnlyTheCritics returns a Tensor; allowed: "):
        rollout_learner(make_loss, engine=engine)


@dataclass(frozen=True, kw_only=True)
class OwnDQN(DQN):
    """Its loss returns something else than TorchRL's."""

    returned: str = "td"

    def make_loss(self, network):
        actor = QValueActor(network, spec=None, action_space="categorical")
        return Odd(actor, delay_value=True, action_space="categorical", returned=self.returned)


class Odd(DQNLoss):
    def __init__(self, *given, returned, **options):
        super().__init__(*given, **options)
        self.returned = returned

    def forward(self, tensordict):
        """The errors under a name that TorchRL does not call a loss, or the loss itself."""
        out = super().forward(tensordict)
        return out["loss"] if self.returned == "number" else out.select("loss").rename_key_("loss", "td")


@pytest.mark.parametrize("engine", ["compiled", "eager", "torchrl"])
@pytest.mark.parametrize(
    ("returned", "came"), [("td", r"TensorDict with the entries \['td'\]"), ("number", "Tensor")]
)
def test_a_loss_that_returns_none_is_refused_by_name_before_training(returned, came, engine):
    algorithm = OwnDQN(settings=REPLAY, returned=returned)
    allowed = f"Odd returns a {came}; allowed: a TensorDict with entries whose names begin with"
    with pytest.raises(ValueError, match=f"the loss test_refusals:{allowed}"):
        make_learner(algorithm, SPACES, agents=(0,), replicas=1, engine=engine)
