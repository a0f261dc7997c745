"""What institutions cannot be, and what does not fit together, is refused by name before anything is made."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from governed import EVERYTHING

from cprl import CommonsEnv, Game, Rules, institutions as law, keys, maps
from cprl.commons.batch import Batch
from cprl.envs import parallel_env

PLAIN = Game(map=maps.parse(">A.\n.A<"), rules=Rules(regrow_prob=(0.0, 0.5)))


@dataclass(frozen=True, kw_only=True)
class Mine(law.Tax):
    """A kind of the user's own."""


@dataclass(frozen=True, kw_only=True)
class Own(law.Institution):
    """Another one."""


VOTES = tuple(law.Vote(on=law.Tax(), choices=tuple(n / 10 for n in range(11))) for _ in range(6))


def governed(*institutions, **changes):
    return replace(PLAIN, institutions=institutions, **changes)


NOBODY_FIRES = {"rules": Rules(may_fire=False)}


@pytest.mark.parametrize(
    ("kind", "fields", "field"),
    [
        (law.Boundaries, {"regions": ("0.", "0")}, r"Boundaries\.regions"),
        (law.Boundaries, {"regions": ("a",), "owners": ("a.",)}, r"Boundaries\.owners"),
        (law.Boundaries.strips, {"height": 1, "width": 40, "agents": 37}, "agents is 37"),
        (law.Boundaries.strips, {"height": 2, "width": 3, "agents": 4}, "agents is 4; allowed: 1 to 3"),
        (law.ClosedSeason, {"period_steps": 5, "closed_steps": 6}, "closed_steps is 6"),
        (law.Tax, {"brackets": ((1, 0.5),)}, r"Tax\.brackets"),
        (law.Tax, {"brackets": ((0, 0.5), (0, 0.6))}, r"Tax\.brackets"),
        (law.Tax, {"brackets": ((0, 1.5),)}, r"Tax\.brackets"),
        (law.Levies, {"groups": ((0,), ())}, r"Levies\.groups"),
        (law.Levies, {"groups": ((0,),), "local_rate": 0.6, "joint_rate": 0.5}, r"Levies\.joint_rate"),
        (law.Vote, {"on": law.Tax(brackets=((0, 0.1),))}, r"Vote\.on"),
        (law.Vote, {"on": law.Tax(), "choices": (0, 2)}, r"Vote\.choices"),
        (law.Vote, {"on": law.Tax(), "choices": (0.5, 0.1)}, r"Vote\.choices"),
        (law.Sanctioner, {"agents": (1, 0)}, r"Sanctioner\.agents"),
        (law.Sanctioner, {"agents": (0,), "override_prob": 0.5}, "override_prob is 0.5"),
        (law.Sanctioner, {"agents": (0,), "period_episodes": 3}, "period_episodes is 3"),
        (law.Monitoring, {"monitor": 1, "period_episodes": 2}, "period_episodes is 2"),
        (law.GraduatedSanctions, {"freeze_steps": ((1,), (2,))}, r"GraduatedSanctions\.on"),
        (law.Rotation, {"window_steps": 0}, r"Rotation\.window_steps"),
    ],
)
def test_what_an_institution_cannot_be_is_refused(kind, fields, field):
    with pytest.raises(ValueError, match=field):
        kind(**fields)


@pytest.mark.parametrize(
    ("institutions", "place"),
    [
        ((law.Boundaries(regions=("0..",)),), r"Boundaries\.regions is 1 x 3; allowed: 2 x 3"),
        ((law.Boundaries(regions=("0..", "..2")),), r"Boundaries\.regions has '2' in row 1"),
        ((law.Boundaries(regions=("a..", "..b"), owners=("a", "a")),), r"Boundaries\.regions"),
        ((law.Boundaries(regions=("a..", "..a"), owners=("a",)),), r"Boundaries\.owners has 1"),
        ((law.Levies(groups=((0,),)),), r"Levies\.groups"),
        ((law.Levies(groups=((0, 1), (1,))),), r"Levies\.groups"),
        ((law.Levies(groups=((0, 1), (2,))),), r"Levies\.groups has agent 2"),
        ((law.Sanctioner(agents=(0, 2)),), r"Sanctioner\.agents has agent 2"),
        ((law.Quota(), law.Monitoring()), "Monitoring has no violation"),
        ((law.Quota(), law.GraduatedSanctions(on="violations")), "GraduatedSanctions .* no offence"),
        ((law.Monitoring(monitor=2),), r"Monitoring\.monitor has agent 2"),
        ((law.GraduatedSanctions(freeze_steps=((1,),), on="tags"),), r"GraduatedSanctions\.freeze_steps"),
        ((law.Monitoring(), law.Tax(), law.Monitoring()), "has 2 of Monitoring"),
        ((law.Sanctioner(),) * 3, "has 3 of Sanctioner"),
        ((law.Mediation(),), r"Mediation\.observed .* Observation\.agents_apart"),
        ((Mine(),), r"Game\.institutions has a Mine"),
        ((Own(),), r"Game\.institutions has a Own"),
        (VOTES, "lets agents choose from 1,771,561 options"),
    ],
)
def test_what_does_not_fit_the_game_is_refused(institutions, place):
    with pytest.raises(ValueError, match=place):
        governed(*institutions)


@pytest.mark.parametrize(
    "needs_tags", [law.Sanctioner(), law.Mediation(observed=False), law.GraduatedSanctions(on="tags")]
)
def test_where_nobody_fires_tags_cannot_be_judged_but_violations_sanctioned(needs_tags):
    governed(law.Quota(fine=1), law.GraduatedSanctions(on="violations"), **NOBODY_FIRES)
    with pytest.raises(ValueError, match=rf"a {type(needs_tags).__name__} and Rules\.may_fire"):
        governed(needs_tags, **NOBODY_FIRES)


@pytest.mark.parametrize(
    ("game", "decisions", "message"),
    [
        (EVERYTHING, np.full((2, 3), EVERYTHING.decisions), "decision .* of agent 0 in world 0 is unknown"),
        (EVERYTHING, np.array([[0, 0, 0], [0, -1, 0]]), "decision -1 of agent 1 in world 1 is unknown"),
        (governed(law.Tax()), np.ones((2, 2), np.int64), "decision 1 of agent 0 in world 0 is unknown"),
    ],
)
def test_wrong_decisions_are_refused(game, decisions, message):
    batch = Batch(game, 2)
    batch.begin()
    with pytest.raises(ValueError, match=message):
        batch.check_decisions(decisions)


def test_the_env_wants_a_decision_that_fits_in_every_turn():
    env = CommonsEnv(EVERYTHING, 2)
    moment = env.reset().set(keys.ACTION, torch.zeros(2, 3, dtype=torch.int64))
    with pytest.raises(ValueError, match="decision"):
        env.step(moment)
    unknown, whole = torch.full((2, 3), EVERYTHING.decisions), torch.zeros(2, 3, 1).long()
    for wrong in (unknown, torch.zeros(2, 3), whole):
        with pytest.raises(ValueError, match="decision"):
            env.step(moment.clone().set(keys.DECISION, wrong))
    assert env.worlds.now.step.tolist() == [[0], [0]]
    env.step(moment.set(keys.DECISION, torch.zeros(2, 3, dtype=torch.int32)))
    assert env.worlds.now.step.tolist() == [[1], [1]]


@pytest.mark.parametrize(
    ("game", "decisions", "message"),
    [
        (EVERYTHING, {"agent_3": 0}, r"the agent of a decision is .*agent_3"),
        (EVERYTHING, {"agent_0": EVERYTHING.decisions}, r"the decision of agent_0 is .*; allowed: "),
        (EVERYTHING, {"agent_0": 0.5}, r"the decision of agent_0 is 0\.5"),
        (PLAIN, {"agent_0": 0}, r"decisions is .*; allowed: None"),
    ],
)
def test_wrong_decisions_of_a_reset_are_refused_and_the_episode_goes_on(game, decisions, message):
    adapter = parallel_env(game, 3)
    adapter.reset()
    adapter.step(dict.fromkeys(game.agent_names, 0))
    before = adapter.batch.state()
    with pytest.raises(ValueError, match=message):
        adapter.reset(options={"decisions": decisions})
    assert all(np.array_equal(before[name], array) for name, array in adapter.batch.state().items())


def test_an_unobserved_vote_hides_its_result_and_not_the_quota_that_is_voted_on():
    hidden = governed(law.Vote(on=law.Quota(), observed=False)).entries_shown
    assert [entry.startswith("quota left") for entry in hidden] == [True, False]
    (in_force,) = governed(law.Vote(on=law.Quota(observed=False))).entries_shown
    assert not in_force.startswith("quota")
