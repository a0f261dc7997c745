"""Tables of episodes: their numbers are of whole episodes, or are refused."""

import numpy as np
import pyarrow as pa
import pytest
from torchrl.envs import StepCounter, TransformedEnv

from cprl import Custom, differences, estimates, presets
from cprl.envs.make_env import make_env
from cprl.experimental import movement
from cprl.measuring.table import all_metrics, by_replica, labelled, where
from cprl.measuring.tracker import check_custom_metrics
from cprl.measuring.windows import last_of
from cprl.policies.actors import RandomActor
from cprl.policies.joint_policy import JointPolicy

RETURNS = np.array([[3.0, 1.0], [2.0, 2.0], [5.0, 0.0], [1.0, 1.0]])


def a_table(*, harvest=RETURNS):
    """Two replicas of two episodes of two agents."""
    replica, episode, agent = (index.ravel() for index in np.indices((2, 2, 2)))
    columns = {"replica": replica, "episode": episode, "agent": agent, "return": RETURNS.ravel()}
    together = np.repeat(harvest.sum(1), 2)
    return pa.table({**columns, "harvest": harvest.ravel(), "collective_return": together})


def test_a_number_that_follows_from_totals_needs_no_column():
    assert estimates(a_table(), "income")["income"].value == (4 + 4 + 5 + 2) / 4
    assert estimates(a_table(), "agent_1/return")["agent_1/return"].value == 1.0
    assert "income" not in all_metrics(a_table()), "it is the harvest"
    assert "income" in all_metrics(a_table(harvest=RETURNS + 1)), "rewards that are no harvest"


@pytest.mark.parametrize(
    "part",
    [lambda rows: rows.sort_by("agent"), lambda rows: where(rows, agent=0), lambda rows: rows.slice(1)],
)
def test_parts_of_episodes_have_no_number_of_all_agents(part):
    with pytest.raises(ValueError, match="not whole episodes"):
        estimates(part(a_table()), "income")
    assert estimates(where(a_table(), agent=0), "collective_return")["collective_return"].value == 3.75


@pytest.mark.parametrize("number", ["agent_9/return", "agent_x/return", "agent_0/foo", "focal/return", "foo"])
def test_a_number_that_a_table_lacks_is_refused_by_its_name(number):
    with pytest.raises(KeyError, match=number):
        by_replica(a_table(), number)


def test_a_label_that_a_table_lacks_is_refused_by_its_name():
    rows = labelled(a_table(), policy="trained")
    with pytest.raises(KeyError, match="no label polcy; it has policy"):
        differences(rows, "income", "polcy", {"polcy": "random"})
    with pytest.raises(ValueError, match="labelled by policy"):
        last_of(rows, 2)


@pytest.mark.parametrize("name", ["role", "composition", "restrained_agents"])
def test_a_metric_of_ones_own_is_called_like_no_column_of_an_evaluation(name):
    with pytest.raises(ValueError, match=f"is called {name}"):
        check_custom_metrics([Custom(f"mine:{name}")])


@pytest.mark.integration
def test_a_world_with_transforms_that_has_ended_is_traced_no_further():
    traces = []
    for wrapped in (lambda env: env, lambda env: TransformedEnv(env, StepCounter())):
        env = wrapped(make_env(presets.game("two_complex"), worlds=3, seed=7))
        policy = JointPolicy([RandomActor(8, seed=agent) for agent in range(2)])
        traces.append(movement.trace(env, policy))
    plain, transformed = traces
    steps = len(plain.played)
    assert transformed.played[:steps].sum() == transformed.played.sum() == plain.played.sum()
    assert np.array_equal(transformed.fired[:steps] & transformed.played[:steps, :, None], plain.fired)
