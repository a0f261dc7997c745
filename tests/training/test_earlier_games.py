"""A training whose game changes: the running episodes are cut, and all that learns carries on."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from dqn_parts import MEADOW, make_learner
from onlookers import Witness
from recordings import column
from same_runs import assert_same_training, is_same
from tiny_study import TINY

import cprl
from cprl import CommonsEnv, Custom, EarlierGame, Experiment, maps
from cprl.algorithms import A2C, DQN, PPO, DQNSettings, RolloutSettings
from cprl.commons.cells import WALL
from cprl.commons.quirks import Quirks2019
from cprl.institutions import Boundaries, Quota, Tax
from cprl.learners.settings import DEFAULT_HIDDEN_CELLS
from cprl.networks import GRU
from cprl.population import Learning, Scripted
from cprl.runs.episodes import read_episodes, read_evaluations
from cprl.studies.factors import with_changes
from cprl.training import Schedule, train

REPLAY = DQNSettings(
    buffer_size=60,
    batch_size=4,
    learning_starts=4,
    steps_per_update=2,
    hidden_cells=(8,),
    learning_rate=1e-2,
    epsilon_decay_steps=50,
    target_every_updates=7,
)
ROLLOUT = RolloutSettings(rollout_steps=8, minibatch_size=4, hidden_cells=(8,), learning_rate=1e-2)
PLAIN = {"hidden_cells": DEFAULT_HIDDEN_CELLS}


def with_rules(game, **rules):
    return replace(game, rules=replace(game.rules, **rules))


ENDLESS = with_rules(MEADOW, episode_steps=1000, plays_on_when_empty=True)
BARE = with_rules(MEADOW, regrow_prob=(0.0, 0.0))
"""Another game, which often ends early."""


def trained(algorithm, earlier, *, worlds=2, engine="eager", **arguments):
    """A training in BARE after an earlier game of 21 turns."""
    agents = make_learner(
        algorithm, MEADOW.spaces, agents=(0, 1), replicas=2, worlds=worlds, seed=1, engine=engine
    )
    envs = [CommonsEnv(game, 2 * worlds, seed=3) for game in (earlier, BARE)]
    return train(
        envs[1],
        {(0, 1): agents},
        Schedule(steps=60 * worlds, worlds=worlds),
        earlier=[(envs[0], 21 * worlds)],
        **arguments,
    )


@pytest.mark.integration
@pytest.mark.parametrize(
    ("algorithm", "engine"),
    [
        (DQN(settings=REPLAY), "compiled"),
        (DQN(settings=REPLAY), "torchrl"),
        (PPO(settings=ROLLOUT), "torchrl"),
        (DQN(settings=replace(REPLAY, n_steps=3)), "eager"),
        (DQN(settings=replace(REPLAY, **PLAIN, sequence_steps=4), network=GRU(recurrent_cells=4)), "eager"),
        (PPO(settings=ROLLOUT), "eager"),
        (A2C(settings=replace(ROLLOUT, **PLAIN), network=GRU(recurrent_cells=4)), "eager"),
    ],
    ids=["compiled", "torchrl", "torchrl ppo", "n_steps", "recurrent", "ppo", "recurrent a2c"],
)
def test_to_what_learns_a_cut_is_a_time_limit(algorithm, engine):
    """A game whose clock ends with the change ends its episodes itself."""
    cut = trained(algorithm, ENDLESS, engine=engine)
    timed = trained(algorithm, with_rules(ENDLESS, episode_steps=21), engine=engine)
    for one, other in zip(cut.learners.values(), timed.learners.values(), strict=True):
        assert repr(one.networks()["replica_1/agent_0"].state_dict()) == repr(
            other.networks()["replica_1/agent_0"].state_dict()
        )
    assert timed.episodes_played - cut.episodes_played == 4, "of 2 replicas of 2 worlds"


def test_the_running_episodes_are_truncated_and_not_counted_and_new_ones_begin():
    witness = Witness()
    changes = []
    witness.on_game = lambda env, words: changes.append((env.game, len(witness.turns), words))
    trained(DQN(settings=REPLAY), ENDLESS, callbacks=[witness])
    last, first = witness.turns[20:22]
    assert last["next", "truncated"].all()
    assert last["next", "done"].all()
    assert not last["next", "terminated"].any()
    assert not witness.turns[19]["next", "done"].any()
    fresh = CommonsEnv(BARE, 4, seed=3).reset()
    assert torch.equal(first["agents", "observation"], fresh["agents", "observation"])
    assert not torch.equal(last["next", "agents", "observation"], fresh["agents", "observation"])
    assert {episode.steps <= 12 for episode in witness.episodes} == {True}
    per_replica = [episode.episode for episode in witness.episodes if episode.replica == 0]
    assert per_replica == list(range(len(per_replica)))
    (game, turns, words) = changes[0]
    assert (len(changes), game, turns) == (1, BARE, 21)
    assert "game.rules.episode_steps was 1000, is 12" in words


def test_an_episode_that_ends_with_the_change_counts():
    witness = Witness()
    trained(DQN(settings=REPLAY), with_rules(MEADOW, episode_steps=7), callbacks=[witness])
    assert len(witness.turns) == 60
    assert [episode.steps for episode in witness.episodes[:12]] == [7] * 12


QUOTA = replace(TINY.game, institutions=(Quota(share=0.8),))
INERT = replace(TINY.game, institutions=(Quota(share=1000.0),))
CHANGING = replace(
    TINY,
    game=INERT,
    earlier=(EarlierGame(game=QUOTA, steps=100),),
    agents=(Learning(DQN(settings=REPLAY)),) * 2,
    episodes=None,
    steps=300,
    worlds=2,
    replicas=2,
)
STOPPING = replace(CHANGING, callbacks=(Custom("own_parts:Stopping"),))


def test_a_recipe_and_paths_of_studies_hold_it():
    assert Experiment.from_config(CHANGING.to_config()) == CHANGING
    changed = with_changes(CHANGING, {"earlier.0.steps": 60, "earlier.0.game.institutions.0.share": 0.5})
    assert changed.earlier[0].steps == 60
    assert changed.earlier[0].game.institutions == (Quota(share=0.5),)
    assert changed.game == INERT


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": None, "episodes": 5}, r"earlier\[0\].steps is 100; allowed in a training of steps"),
        ({"steps": 101}, r"earlier\[0\].steps is 100; .*: 2 to 99"),
        ({"earlier": (EarlierGame(game=QUOTA, steps=1),)}, r"earlier\[0\].steps is 1; .* 2 worlds: 2 to 298"),
        ({"earlier": CHANGING.earlier * 3}, r"earlier\[2\].steps is 100; .* after 200 steps: 2 to 98"),
    ],
)
def test_steps_that_leave_no_turn_for_a_game_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(CHANGING, **changes)


@pytest.mark.parametrize(
    ("game", "message"),
    [
        (replace(INERT, map=maps.with_agents(INERT.map, 3)), r"earlier\[0\].game has agents .*agent_2"),
        (with_rules(INERT, window_rows=3), r"earlier\[0\].game has observations"),
        (with_rules(INERT, may_fire=False), r"earlier\[0\].game has a number of actions of 7"),
        (TINY.game, r"earlier\[0\].game has observations"),
        (replace(INERT, institutions=(Tax(),)), r"earlier\[0\].game has observations"),
    ],
)
def test_a_game_for_other_agents_is_refused_before_anything_is_written(game, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        cprl.run(
            replace(CHANGING, earlier=(EarlierGame(game=game, steps=100),)), tmp_path / "run", watch="off"
        )
    assert not (tmp_path / "run").exists()


QUIRKY = with_rules(TINY.game, quirks=Quirks2019())


@pytest.mark.parametrize(
    ("policy", "earlier", "game", "message"),
    [
        (
            "territorial",
            with_rules(TINY.game, beam_length_cells=1),
            TINY.game,
            r"territorial .* a beam_length_c",
        ),
        (
            "sustainable",
            with_rules(TINY.game, regrow_radius_cells=1.0),
            TINY.game,
            "regrow_radius_cells of 1.0",
        ),
        ("greedy", TINY.game, QUIRKY, "greedy agents a quirks of None"),
    ],
)
def test_rules_by_which_scripted_agents_play_stay(policy, earlier, game, message, tmp_path):
    experiment = replace(
        CHANGING,
        game=game,
        earlier=(EarlierGame(game=earlier, steps=100),),
        agents=(CHANGING.agents[0], Scripted(policy)),
    )
    with pytest.raises(ValueError, match=message):
        cprl.run(experiment, tmp_path / "run", watch="off")
    assert not (tmp_path / "run").exists()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nobody stopped, by the algorithm of its agents."""
    runs = {}

    def trained_once(experiment):
        name = type(experiment.agents[0].algorithm).__name__ + experiment.engine
        if name not in runs:
            runs[name] = cprl.run(experiment, tmp_path_factory.mktemp(name) / "run", watch="off")
        return runs[name]

    return trained_once


@pytest.mark.integration
@pytest.mark.parametrize("at_step", [30, 50, 51, 90], ids=["before", "at", "after", "long after"])
@pytest.mark.parametrize("algorithm", [DQN(settings=REPLAY), PPO(settings=ROLLOUT)], ids=["dqn", "ppo"])
def test_a_training_resumes_exactly_on_either_side_of_the_change(
    at_step, algorithm, whole, stopped, tmp_path, capsys
):
    experiment = replace(STOPPING, agents=(Learning(algorithm),) * 2)
    expected = whole(experiment)
    run = stopped(at_step, experiment, tmp_path / "run")
    cprl.run(experiment, run, resume=True, watch="off")
    assert_same_training(run, expected)
    assert f"step {2 * at_step}" in capsys.readouterr().out
    assert len(read_episodes(run)) == 2 * 2 * 2 * (2 + 5)


def hidden(*institutions):
    return replace(TINY.game, institutions=institutions)


@pytest.mark.integration
def test_episodes_of_a_game_without_an_institution_have_its_columns(tmp_path):
    """Agents do not see these rules, so that they can play with and without them."""
    games = [hidden(Tax(observed=False)), TINY.game, hidden(Quota(share=0.8, fine=0.5, observed=False))]
    for name, order in {"first": games, "last": games[::-1]}.items():
        parts = tuple(EarlierGame(game=game, steps=100) for game in order[:2])
        experiment = replace(CHANGING, game=order[2], earlier=parts)
        run = cprl.run(experiment, tmp_path / name, watch="off")
        rows = read_episodes(run)
        fines = rows["institutions/fines"].to_numpy()
        by_game = np.array_split(fines, 3)
        assert np.isnan(by_game[1]).all()
        assert not np.isnan(by_game[0][:4]).any()
        assert not np.isnan(by_game[2][-4:]).any()
        assert not any(rows[column].null_count for column in ("fines", "transfers", "violations"))


def bounded():
    """A game on a larger board with regions."""
    wide = maps.parse(".>A.AA.\nA.A....\n..A<A..\n.......")
    fields = Boundaries.strips(height=4, width=7, agents=2)
    return replace(TINY.game, map=wide, institutions=(replace(fields, observed=False),))


@pytest.mark.integration
@pytest.mark.parametrize("before", [bounded(), bounded], ids=["value", "function"])
def test_a_recording_shows_the_board_that_is_played(before, tmp_path):
    parts = (EarlierGame(game=before, steps=100),)
    run = cprl.run(replace(CHANGING, game=TINY.game, earlier=parts), tmp_path / "run")
    file = run / "run.rrd"
    steps, boards = column(file, "world/board", "SegmentationImage:buffer")
    pictures = {step: np.array(board[0]).reshape(6, 9) for step, board in zip(steps, boards, strict=True)}
    assert min(pictures) < 100 < max(pictures), "frames of both games"
    beyond = {step: (picture[4:, 1:-1] == WALL).all() for step, picture in pictures.items()}
    assert beyond == {step: step > 100 for step in pictures}
    steps, borders = column(file, "world/regions", "LineStrips2D:strips")
    assert [(step, len(strips) > 0) for step, strips in zip(steps, borders, strict=True)] == [
        (0, True),
        (100, False),
    ]
    events = [text[0] for text in column(file, "log", "TextLog:text")[1]]
    assert any(text.startswith("from step 100 on: game.map.") for text in events)


@pytest.mark.integration
def test_transforms_carry_on_and_evaluations_share_them(stopped, tmp_path):
    fatigue = Custom("own_parts:Fatigue", arguments={"per_step": 0.01})
    experiment = replace(STOPPING, transforms=(fatigue,), evaluate_every=2)
    whole = cprl.run(experiment, tmp_path / "whole", watch="off")
    run = stopped(60, experiment, tmp_path / "run")
    cprl.run(experiment, run, resume=True, watch="off")
    assert_same_training(run, whole)
    assert is_same(*(read_evaluations(made).to_pydict() for made in (run, whole)))
    for made in (run, whole):
        (steps,) = torch.load(made / "checkpoints" / "transforms.pt", weights_only=True).values()
        assert steps == 150, "turns of both games"
