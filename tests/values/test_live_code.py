"""Classes and functions that no module has, of a script, a notebook or a test, are handed over live."""

import json
import multiprocessing
from dataclasses import replace
from functools import partial
from types import FunctionType

import pytest
import torch
from own_parts import Dilemma, gap
from same_runs import live
from tiny_study import FREEZE, GAME, TINY
from torch import nn
from torchrl.envs import Transform
from torchrl.objectives import DQNLoss

import cprl
from cprl import Custom, Experiment, Study
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.algorithms.base import q_actor
from cprl.experimental.search import Search
from cprl.networks import Conv
from cprl.population import Learning
from cprl.runs.episodes import read_episodes
from cprl.runs.recipe import resume_command, start_run
from cprl.values import custom, custom_of, trusting


def longest(episode):
    """The steps of the episode."""
    return episode.steps


@live
def most(episode, *, beside=0):
    """What the agent with most harvested."""
    return episode.harvest.max() - beside


@pytest.fixture
def measured():
    return replace(TINY, metrics=[most])


def train(experiment, out, **options):
    return cprl.run(experiment, out, watch="off", **options)


@pytest.fixture
def another_process(monkeypatch):
    """Makes this process one that was handed nothing."""

    def becomes_another():
        monkeypatch.setattr(custom, "_LIVE", {})

    return becomes_another


@pytest.mark.integration
def test_a_function_of_a_script_is_measured_evaluated_and_named_in_the_recipe(measured, tmp_path):
    run = train(measured, tmp_path / "run")
    columns = read_episodes(run).select(["episode", "most", "harvest"])
    for episode in set(columns["episode"].to_pylist()):
        rows = [row for row in columns.to_pylist() if row["episode"] == episode]
        assert {row["most"] for row in rows} == {max(row["harvest"] for row in rows)}
    (stored,) = json.loads((run / "recipe.json").read_text())["experiment"]["metrics"]
    assert (stored["target"], stored["live"]) == ("__main__:most", measured.metrics[0].live)
    assert cprl.load(run).experiment == measured
    assert "most" in cprl.evaluate_run(run, cprl.Fresh(episodes=1)).column_names


@pytest.mark.integration
def test_another_process_reads_the_tables_and_is_refused_the_rest_by_name(
    measured, tmp_path, another_process
):
    run = train(measured, tmp_path / "run")
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    another_process()
    assert "most" in read_episodes(run).column_names
    for refused in (
        lambda: cprl.load(run),
        lambda: cprl.evaluate_run(run, cprl.Fresh(episodes=1)),
        lambda: train(replace(TINY, metrics=[most], episodes=5), run, resume=True),
    ):
        with pytest.raises(ValueError, match="has __main__:most, which only the process"):
            refused()
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_what_needs_other_processes_refuses_it_by_name(measured, tmp_path):
    with pytest.raises(ValueError, match="the study 'tiny' has __main__:most, which"):
        Study(measured, {FREEZE: [2, 5]})
    with pytest.raises(ValueError, match="__main__:most"):
        Search(measured, {FREEZE: [2, 5]}, points=1)
    start_run(tmp_path / "run", "tiny", measured.to_recipe)
    line = resume_command(tmp_path / "run")
    assert line.startswith("cprl.run(")
    assert line.endswith("in this process; no other can, as it alone has __main__:most")


@pytest.mark.integration
def test_the_process_that_has_it_extends_the_run_bit_for_bit(measured, tmp_path):
    longer = replace(measured, episodes=4)
    run = train(measured, tmp_path / "run", keep_checkpoint=True)
    train(longer, run, resume=True)
    whole = train(longer, tmp_path / "whole")
    assert read_episodes(run).equals(read_episodes(whole))

    @live
    def most(episode):
        return 0.0

    with pytest.raises(
        ValueError, match=r"metrics\[0\] was __main__:\S*most, is \S*most that was defined again"
    ):
        train(replace(longer, metrics=[most], episodes=5), run, resume=True)


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_what_a_forked_process_is_handed_is_not_what_this_one_is_handed_next():
    def first(episode):
        return 1.0

    def second(episode):
        return 2.0

    with multiprocessing.get_context("fork").Pool(1) as pool:
        ((target, theirs),) = pool.map(_handed, [1])
    assert custom_of(first).live != theirs
    assert custom_of(second).live != theirs
    with pytest.raises(ValueError, match="which only the process that it was handed to"):
        Custom(target, live=theirs).resolve()


def _handed(number):
    custom = custom_of(lambda episode: number)
    return custom.target, custom.live


def test_a_strangers_name_of_something_live_is_shown_on_a_line(tmp_path):
    odd = {"kind": "Custom", "target": "\x1b[2Jevil:x\n", "arguments": {}, "live": "00000000-0"}
    with pytest.raises(ValueError, match=r"has \?\[2Jevil:x\?, which only"):
        Experiment.from_config({**TINY.to_config(), "metrics": [odd]})
    with pytest.raises(ValueError, match=r"Custom\.target is"):
        Custom(odd["target"], live=odd["live"])
    start_run(tmp_path / "run", "x", lambda run: {**TINY.to_recipe(), "experiment": {"metrics": [odd]}})
    assert resume_command(tmp_path / "run").isprintable()


def test_the_advice_for_what_cannot_be_stored_is_allowed_itself():
    class Kept:
        def measure(self, episode):
            return 0.0

        def __call__(self, episode):
            return 0.0

    itself = "allowed: values of cprl, or a class or function of your own itself, or a functools.partial"
    for refused in (Kept().measure, Kept(), max):
        with pytest.raises(ValueError, match=itself) as error:
            replace(TINY, metrics=[refused])
        assert "Custom(" not in str(error.value)
    with pytest.raises(ValueError, match=r"a functools\.partial of a class .* with keyword arguments alone"):
        replace(TINY, metrics=[partial(most, 3)])
    with pytest.raises(ValueError, match=r"DQN\.network is a partial, .*allowed: Conv\(\.\.\.\)"):
        Learning(DQN(settings=DQNSettings(), network=partial(Conv, channels=(4, 4))))


def test_levels_of_a_study_are_classes_and_functions_as_an_experiment_takes_them():
    by_name = Study(TINY, conditions={"without": {}, "with": {"metrics": (longest,)}})
    assert by_name.all_conditions[1].experiment == replace(TINY, metrics=[longest])
    factors = {"agents.0.algorithm.network": [None, Mixed]}
    assert Study(TINY, factors).all_conditions[1].experiment.agents[0].algorithm.network == Custom(
        "test_live_code:Mixed"
    )
    named = Study(TINY, {"measured": {"no": {}, "yes": {"metrics": [longest]}}})
    assert named.all_conditions[1].experiment.metrics == (Custom("test_live_code:longest"),)
    with trusting(["test_live_code:longest", "test_live_code:Mixed"]):
        for study in (by_name, Study(TINY, factors), named):
            assert Study.from_config(json.loads(json.dumps(study.to_config()))) == study
    with pytest.raises(ValueError, match="the study 'tiny' has __main__:most, which only the process"):
        Study(TINY, conditions={"with": {"metrics": [most]}})


class Mixed(nn.Module):
    """A network of the user's own."""


def test_one_at_the_top_of_a_module_is_kept_by_its_name():
    by_name = replace(TINY, metrics=[gap, longest])
    assert by_name.metrics == (Custom("own_parts:gap"), Custom("test_live_code:longest"))
    assert all(metric.live == "" for metric in by_name.metrics)


def test_arguments_are_those_of_a_partial():
    less = replace(TINY, metrics=[partial(most, beside=3)]).metrics[0]
    assert less.arguments == {"beside": 3}
    assert less == replace(TINY, metrics=[partial(most, beside=3)]).metrics[0]
    with pytest.raises(ValueError, match=r"metrics\[0\] is a partial"):
        replace(TINY, metrics=[partial(most, 3)])
    with pytest.raises(ValueError, match=r"__main__:most.*cannot be kept as JSON"):
        replace(TINY, metrics=[partial(most, beside=object())])


@pytest.mark.integration
def test_whatever_is_handed_in_by_its_name_may_be_live(tmp_path):
    started = []

    class Halved(Transform):
        def _step(self, tensordict, next_tensordict):
            next_tensordict["agents", "reward"] = next_tensordict["agents", "reward"] / 2
            return next_tensordict

    class Counting:
        def on_start(self, training):
            started.append(training)

    class Linear(nn.Linear):
        def __init__(self, spaces, outputs):
            self.axes = len(spaces.observation_shape)
            super().__init__(torch.Size(spaces.observation_shape).numel(), outputs)

        def forward(self, observation):
            return super().forward(observation.flatten(-self.axes).float())

    def linear(**settings):
        return DQN(settings=DQNSettings(**settings), network=Linear)

    class Own(Dilemma):
        pass

    agent = Learning(partial(linear, buffer_size=50))
    experiment = replace(TINY, agents=(agent, agent), transforms=[Halved], callbacks=[Counting])
    run = train(experiment, tmp_path / "run")
    assert len(started) == 1
    rows = read_episodes(run)
    assert rows["return"].to_pylist() == [harvest / 2 for harvest in rows["harvest"].to_pylist()]
    assert type(cprl.load(run).networks["replica_0/agent_0"]) is Linear
    own = train(replace(TINY, game=Own(), agents=(agent, agent)), tmp_path / "own")
    assert cprl.load(own).experiment.game == Own()


def stock(network, settings):
    """The loss that DQN has by itself."""
    loss = DQNLoss(q_actor(network), loss_function="l2", delay_value=True, action_space="categorical")
    loss.make_value_estimator(gamma=settings.gamma)
    return loss


def clipped(networks, settings):
    """The loss that PPO has by itself."""
    return PPO(settings=settings).make_loss(networks)


@pytest.mark.integration
@pytest.mark.parametrize("loss", [stock, clipped])
def test_a_loss_takes_the_place_of_an_algorithms_in_one_line(loss, tmp_path):
    ppo = PPO(settings=RolloutSettings(rollout_steps=10, minibatch_size=5, hidden_cells=(4,)))
    algorithm = TINY.agents[0].algorithm if loss is stock else ppo
    of_own = replace(algorithm, loss=loss)
    assert of_own.loss == Custom(f"test_live_code:{loss.__name__}")
    runs = [
        train(replace(TINY, agents=(Learning(each),) * 2), tmp_path / str(number))
        for number, each in enumerate((algorithm, of_own, replace(algorithm, loss=live_copy(loss))))
    ]
    plain, *others = (read_episodes(run) for run in runs)
    assert all(plain.equals(other) for other in others)
    cprl.trust(f"test_live_code:{loss.__name__}")
    networks = [cprl.load(run).networks["replica_0/agent_0"].state_dict() for run in runs]
    for network in networks[1:]:
        torch.testing.assert_close(network, networks[0], rtol=1e-5, atol=1e-6)


def live_copy(function):
    return live(FunctionType(function.__code__, function.__globals__, function.__name__))


def test_what_a_loss_of_ones_own_does_not_read_is_refused_and_so_is_what_is_no_loss():
    settings = DQNSettings()
    for kind, field, value in (
        *((DQN, "double", True), (DQN, "loss_function", "l1")),
        *((PPO, "entropy_coeff", 0.5), (PPO, "clip_epsilon", 0.1)),
    ):
        made = settings if kind is DQN else RolloutSettings()
        with pytest.raises(
            ValueError, match=rf"^{kind.__name__}\.{field} is {value!r}; .*test_live_code:stock"
        ):
            kind(settings=made, loss=stock, **{field: value})
    spaces = GAME.spaces
    for no_loss in (lambda network, settings: network, lambda network: None):
        algorithm = DQN(settings=settings, loss=no_loss)
        with pytest.raises(ValueError, match=r"<lambda>.*(LossModule|does not take its arguments)"):
            algorithm.make_loss(algorithm.make_network(spaces))


def test_two_of_the_same_name_are_not_the_same():
    def made(cells):
        def own(spaces, outputs):
            return nn.Linear(cells, outputs)

        return DQN(settings=DQNSettings(), network=own)

    one, other = made(1), made(2)
    assert one.network.target == other.network.target
    assert one != other
    assert one == replace(one, network=one.network)


def test_what_has_no_name_or_is_no_function_is_refused():
    with pytest.raises(ValueError, match="<lambda>: a metric is called as its function"):
        replace(TINY, metrics=[lambda episode: 1.0])
    for wrong in (len, int, DQN, "own", nn.ReLU(), [most]):
        with pytest.raises(ValueError, match=r"experiment\.(metrics|callbacks)"):
            replace(TINY, callbacks=[wrong], metrics=[wrong] if isinstance(wrong, type) else ())
