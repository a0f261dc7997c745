"""What institutions cannot be, and what does not fit together, is refused by name before anything is made."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from governed import EVERYTHING, kept

from cprl import CommonsEnv, Game, Observation, Rules, keys, maps
from cprl.commons.batch import Batch
from cprl.envs import parallel_env
from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    GraduatedSanctions,
    Institution,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Sanctioner,
    Tax,
    Vote,
)

PLAIN = Game(map=maps.parse(">A.\n.A<"), rules=Rules(regrow_prob=(0.0, 0.5)))


@dataclass(frozen=True, kw_only=True)
class Mine(Tax):
    """A kind of the user's own."""


@dataclass(frozen=True, kw_only=True)
class Own(Institution):
    """Another one."""


VOTES = tuple(Vote(on=Tax(), choices=tuple(n / 10 for n in range(11))) for _ in range(6))


@pytest.mark.parametrize(
    ("institutions", "message"),
    [
        ([Boundaries(regions=("0..",))], r"Boundaries\.regions is 1 x 3; allowed: 2 x 3"),
        ([Boundaries(regions=("0..", "..2"))], r"Boundaries\.regions has '2' in row 1, column 2"),
        ([Boundaries(regions=("a..", "..b"), owners=("a", "a"))], r"Boundaries\.regions has 'b'"),
        ([Boundaries(regions=("a..", "..a"), owners=("a",))], r"Boundaries\.owners has 1"),
        ([Levies(groups=((0,),))], r"Levies\.groups"),
        ([Levies(groups=((0, 1), (1,)))], r"Levies\.groups"),
        ([Levies(groups=((0, 1), (2,)))], r"Levies\.groups has agent 2"),
        ([Sanctioner(agents=(0, 2))], r"Sanctioner\.agents has agent 2"),
        ([Quota(), Monitoring()], r"Monitoring has no violation to detect"),
        ([Quota(), GraduatedSanctions(on="violations")], r"GraduatedSanctions .* has no offence to sanction"),
        ([Monitoring(monitor=2)], r"Monitoring\.monitor has agent 2"),
        ([GraduatedSanctions(freeze_steps=((1,),), on="tags")], r"GraduatedSanctions\.freeze_steps has 1"),
        ([Monitoring(), Tax(), Monitoring()], r"has 2 of Monitoring"),
        ([ClosedPatches(), ClosedPatches()], r"has 2 of ClosedPatches"),
        ([GraduatedSanctions()] * 2, r"has 2 of GraduatedSanctions"),
        ([Mediation(observed=False)] * 2, r"has 2 of Mediation"),
        ([Sanctioner()] * 3, r"has 3 of Sanctioner"),
        ([Mediation()], r"Mediation\.observed is True and Observation\.agents_apart is False"),
        ([Mine()], r"Game\.institutions has a Mine"),
        ([Own()], r"Game\.institutions has a Own"),
        ([Tax()] * 65, r"Game\.institutions has 65"),
        (VOTES, r"lets agents choose from 1,771,561 options"),
    ],
)
def test_what_does_not_fit_the_game_is_refused(institutions, message):
    with pytest.raises(ValueError, match=message):
        replace(PLAIN, institutions=tuple(institutions))


@pytest.mark.parametrize("wrong", [(Tax,), Tax()])
def test_what_is_no_institution_is_refused(wrong):
    with pytest.raises(ValueError, match=r"^Game\.institutions"):
        replace(PLAIN, institutions=wrong)


@pytest.mark.parametrize(
    "own", [Sanctioner(), Sanctioner(agents=(0,)), Mediation(observed=False), GraduatedSanctions(on="tags")]
)
def test_where_nobody_fires_what_follows_from_shots_is_refused(own):
    with pytest.raises(ValueError, match=rf"a {type(own).__name__} and Rules\.may_fire is False"):
        replace(PLAIN, rules=Rules(may_fire=False), institutions=(own,))
    of_violations = Quota(fine=1), GraduatedSanctions(on="violations")
    replace(PLAIN, rules=Rules(may_fire=False), institutions=of_violations)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Boundaries(regions=("0.", "0")), r"Boundaries\.regions"),
        (lambda: Boundaries(regions=("a",), owners=("a.",)), r"Boundaries\.owners"),
        (lambda: Boundaries.strips(height=1, width=40, agents=37), r"agents is 37"),
        (lambda: ClosedSeason(period_steps=5, closed_steps=6), r"closed_steps is 6"),
        (lambda: Tax(brackets=((1, 0.5),)), r"Tax\.brackets"),
        (lambda: Tax(brackets=((0, 0.5), (0, 0.6))), r"Tax\.brackets"),
        (lambda: Tax(brackets=((0, 1.5),)), r"Tax\.brackets"),
        (lambda: Levies(groups=((0,), ())), r"Levies\.groups"),
        (lambda: Levies(groups=((0,),), local_rate=0.6, joint_rate=0.5), r"Levies\.joint_rate"),
        (lambda: Vote(on=Tax(brackets=((0, 0.1),))), r"Vote\.on"),
        (lambda: Vote(on=Tax(), choices=(0, 2)), r"Vote\.choices"),
        (lambda: Vote(on=Tax(), choices=(0.5, 0.1)), r"Vote\.choices"),
        (lambda: Sanctioner(agents=(1, 0)), r"Sanctioner\.agents"),
        (lambda: GraduatedSanctions(freeze_steps=((1,), (2,)), on="both"), r"GraduatedSanctions\.on"),
    ],
)
def test_what_an_institution_cannot_be_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def begun():
    batch = Batch(EVERYTHING, 2)
    return batch, batch.begin(batch.new_output())


@pytest.mark.parametrize(
    ("decisions", "message"),
    [
        (np.full((2, 3), EVERYTHING.decisions), rf"decision {EVERYTHING.decisions} of agent 0 in world 0 is"),
        (np.array([[0, 0, 0], [0, -1, 0]]), r"decision -1 of agent 1 in world 1 is unknown; allowed: 0 to"),
        (np.zeros((2, 2), np.int64), r"decisions is int64 \[2, 2\]; allowed: int64 \[2, 3\]"),
        (np.zeros((2, 3)), r"decisions is float64 \[2, 3\]; allowed: int64 \[2, 3\]"),
        (np.zeros((2, 6), np.int64)[:, ::2], r"int64 \[2, 3\] is not contiguous"),
    ],
)
def test_wrong_decisions_are_refused_and_nothing_has_changed(decisions, message):
    batch, output = begun()
    before = kept(batch, output)
    with pytest.raises(ValueError, match=message):
        batch.play(np.zeros((2, 3), np.int64), output, decisions)
    for one, other in zip(before, kept(batch, output), strict=True):
        assert all(map(np.array_equal, one, other))


def test_decisions_in_a_game_without_any_are_refused():
    batch = Batch(replace(PLAIN, institutions=(Tax(),)), 1)
    output = batch.begin(batch.new_output())
    with pytest.raises(ValueError, match=r"decision 1 of agent 0 in world 0 is unknown; allowed: 0 to 0"):
        batch.play(np.zeros((1, 2), np.int64), output, np.ones((1, 2), np.int64))


def test_the_env_wants_a_decision_that_fits_in_every_turn():
    env = CommonsEnv(EVERYTHING, 2)
    moment = env.reset().set(keys.ACTION, torch.zeros(2, 3, dtype=torch.int64))
    with pytest.raises(ValueError, match=r'\("agents", "decision"\) is missing; allowed: int64 \[2, 3\]'):
        env.step(moment)
    for wrong, message in (
        (torch.full((2, 3), EVERYTHING.decisions), "decision .* of agent 0 in world 0 is unknown"),
        (torch.zeros(2, 3), r'\("agents", "decision"\) is torch.float32; allowed: int64 \[2, 3\]'),
    ):
        with pytest.raises(ValueError, match=message):
            env.step(moment.clone().set(keys.DECISION, wrong))
    assert env.worlds.now.step.tolist() == [[0], [0]]
    env.step(moment.set(keys.DECISION, torch.zeros(2, 3, dtype=torch.int32)))
    assert env.worlds.now.step.tolist() == [[1], [1]]


@pytest.mark.parametrize(
    ("decisions", "message"),
    [
        ({"agent_3": 0}, r"the agent of a decision is .*agent_3"),
        ({"agent_0": EVERYTHING.decisions}, r"the decision of agent_0 is .*; allowed: "),
        ({"agent_0": 0.5}, r"the decision of agent_0 is 0\.5"),
        ([0, 1, 2], r"decisions is .*; allowed: a dict of decisions"),
    ],
)
def test_wrong_decisions_of_a_reset_are_refused_and_the_episode_goes_on(decisions, message):
    adapter = parallel_env(EVERYTHING, 3)
    adapter.reset()
    adapter.step(dict.fromkeys(EVERYTHING.agent_names, 0))
    before = adapter.batch.state()
    with pytest.raises(ValueError, match=message):
        adapter.reset(options={"decisions": decisions})
    assert all(np.array_equal(before[name], array) for name, array in adapter.batch.state().items())


def test_decisions_where_nothing_is_decided_are_refused():
    with pytest.raises(
        ValueError, match=r"decisions is .*; allowed: None: agents decide nothing in this game"
    ):
        parallel_env(PLAIN).reset(options={"decisions": {"agent_0": 0}})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"taken": -1}, r"state\['taken'\]\[0, 0, 0\] is -1; allowed: 0 to 25"),
        ({"taken": 26}, r"state\['taken'\]\[0, 0, 0\] is 26; allowed: 0 to 25"),
        ({"level": -1}, r"state\['level'\]\[0, 0\] is -1"),
        ({"offence_step": 26}, r"state\['offence_step'\]\[0, 0\] is 26; allowed: 0 to 25"),
        ({"violation_step": -2}, r"state\['violation_step'\]\[0, 0\] is -2; allowed: 0 to 25"),
        ({"counts": -1}, r"state\['counts'\]\[0, 0, 0\] is -1"),
        ({"allowed": np.nan}, r"state\['allowed'\]\[0, 0\] is nan; allowed: a number of at least 0"),
        ({"income": np.inf}, r"state\['income'\]\[0, 0, 0\] is inf; allowed: a number of at least 0"),
        ({"in_force": 0.7}, r"state\['in_force'\]\[0, 0\] is 0\.7; allowed: one of \[0\.5, 1, 2\]"),
    ],
)
def test_a_state_that_institutions_cannot_be_in_is_refused_and_changes_nothing(change, message):
    batch, output = begun()
    state, before = batch.state(), kept(batch, output)
    for name, value in change.items():
        state[name].reshape(-1)[0] = value
    with pytest.raises(ValueError, match=message):
        batch.load(state, output)
    for one, other in zip(before, kept(batch, output), strict=True):
        assert all(map(np.array_equal, one, other))


def test_a_state_of_the_game_without_institutions_is_refused_and_the_other_way_round():
    with_, without = begun()[0], Batch(replace(EVERYTHING, institutions=()), 2)
    without.begin(without.new_output())
    with pytest.raises(ValueError, match=r"the state lacks \['allowed', 'counts'"):
        with_.load(without.state(), with_.new_output())
    with pytest.raises(ValueError, match=r"has the unknown entries \['allowed', 'counts'"):
        without.load(with_.state(), without.new_output())


def test_a_state_from_before_the_first_episode_can_be_put_back():
    batch = Batch(replace(EVERYTHING, observation=Observation(agents_apart=True)), 2)
    other = Batch(batch.game, 2)
    other.load(batch.state(), other.new_output())
    assert all(np.array_equal(array, other.state()[name]) for name, array in batch.state().items())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Sanctioner(agents=(0,), override_prob=0.5),
            r"override_prob is 0\.5 and nobody is elected; allowed: 0\.0, or others where agents is None",
        ),
        (lambda: Sanctioner(agents=(0,), period_episodes=3), "period_episodes is 3 and nobody is elected"),
        (
            lambda: Monitoring(monitor=1, period_episodes=2),
            'period_episodes is 2 and nobody is elected; allowed: 1, or others where monitor is "elected"',
        ),
    ],
)
def test_what_is_said_of_an_election_that_is_not_held_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_an_unobserved_vote_hides_its_result_and_not_the_quota_that_is_voted_on():
    observation = replace(PLAIN.observation, encoding="one_hot")
    shown = [
        replace(
            PLAIN, observation=observation, institutions=(Vote(on=quota, observed=observed),)
        ).entries_shown
        for quota, observed in ((Quota(), False), (Quota(observed=False), True))
    ]
    assert [entry.startswith("quota left") for entry in shown[0]] == [True, False]
    assert len(shown[1]) == 1
    assert not shown[1][0].startswith("quota")
