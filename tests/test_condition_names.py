"""What conditions are called: the levels of their factors in a few words."""

import pytest

from cprl.algorithms import DQN, VDN, DQNSettings
from cprl.institutions import Quota, Sanctioner
from cprl.networks import MLP
from cprl.population import Learning, Scripted, Team
from cprl.studies.study import level_text, named, short_names

LEARNER = DQN(settings=DQNSettings())


@pytest.mark.parametrize(
    ("level", "text"),
    [
        (0.1 + 0.2, "0.3"),
        ((1, 2.5), "(1, 2.5)"),
        ("greedy", "greedy"),
        (Scripted("greedy"), "Scripted(greedy)"),
        (LEARNER, "DQN"),
        (Learning(LEARNER), "Learning(DQN)"),
        (Team(VDN(settings=DQNSettings()), (0, 1)), "Team(VDN)"),
        (MLP(hidden_cells=(8, 8)), "MLP((8, 8))"),
        ((), "()"),
        ((Quota(share=0.5), Sanctioner()), "(Quota(0.5), Sanctioner)"),
    ],
)
def test_a_level_is_told_by_its_value_and_an_agent_by_what_it_is(level, text):
    assert level_text(level) == text


def test_a_factor_is_named_by_its_last_word_where_that_tells_it():
    assert named({"agents.0": Scripted("greedy")}) == "agents.0=Scripted(greedy)"
    paths = ["agents.0", "game.rules.freeze_steps", "a.gamma", "b.gamma"]
    assert short_names(paths) == {
        "agents.0": "agents.0",
        "game.rules.freeze_steps": "freeze_steps",
        "a.gamma": "a.gamma",
        "b.gamma": "b.gamma",
    }
