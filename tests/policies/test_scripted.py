"""Scripted policies: each behaves as documented, given its window alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from boards import Play, drawn, only_quirks
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl import CommonsEnv, Game, Observation, River, Rules, maps, presets
from cprl.commons.rules import ACTIONS
from cprl.measuring.playing import evaluate
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.scripted import SCRIPTED_POLICIES, Plan, ScriptedActor


class Stays(nn.Module):
    """Never moves."""

    def __init__(self, stay):
        super().__init__()
        self.stay = stay

    def forward(self, tensordict):
        return tensordict.set("action", torch.full(tensordict.batch_size, self.stay))


class Scene(Play):
    """A drawn board on which agent 0 follows a policy and all others stay; played through CommonsEnv."""

    def __init__(self, drawing, policy, *, worlds=1, seed=0, spare=3, region=None, tag=None, **rules):
        self.game = Game(
            map=maps.parse(drawing),
            rules=Rules(**{"regrow_prob": (0.0,), **rules}),
            observation=Observation(agents_apart=tag is not None),
        )
        seeds = [(seed, world) for world in range(worlds)]
        numbers = {"spare": spare, "region": region, "tag": tag}
        actor = ScriptedActor(Plan(policy, **numbers), self.game, seeds=seeds, agents=1)
        others = {agent: Stays(self.game.actions.index("stay")) for agent in range(1, self.game.agents)}
        self.policy = JointPolicy({(0,): actor, **others})
        self.env = CommonsEnv(self.game, worlds, seed=seed)
        self.batch, self.bitten = self.env.worlds, 0.0

    def go(self, turns):
        """The names of the actions of agent 0 in the first world; a world that has ended does not change."""
        names, moment = [], self.env.reset()
        for _ in range(turns):
            batch = self.env.step(self.policy(moment))
            names.append(self.game.actions[batch["agents", "action"][0, 0]])
            moment = batch["next"].exclude(("agents", "reward"))
            self.bitten += float(moment["agents", "harvest"][:, 0].sum())
        return names


def test_greedy_takes_the_shortest_path_around_walls_to_the_nearest_apple():
    scene = Scene("..A.\nA##.\n..^A", "greedy", may_fire=False)
    assert scene.go(4) == ["right", "forward", "forward", "left"]
    assert (scene.board, scene.bitten) == (drawn("..^.\nA##.\n...."), 2)


@pytest.mark.filterwarnings("ignore:no agent can harvest:UserWarning")
def test_greedy_wanders_if_a_wall_closes_off_the_only_apple():
    scene = Scene("..#A\n.^#.", "greedy", worlds=64, may_fire=False)
    scene.go(1)
    first = scene.env.worlds.now.row[:, 0]
    assert 0.75 < (first == 0).mean() < 1, "they wander: most walk forward, some turn"


def test_greedy_finds_an_apple_outside_its_first_window():
    scene = Scene(".......\n<.....A\n.......", "greedy", worlds=20, may_fire=False, window_columns=5)
    scene.go(150)
    assert scene.bitten == 20


CROSS = """
    ..A..
    .AAA.
    ..A..
    .....
    ..^..
"""


@pytest.mark.parametrize("paint_over", [False, True])
@pytest.mark.parametrize(
    ("policy", "spare", "left"), [("sustainable", 3, 3), ("sustainable", 1, 1), ("greedy", 3, 0)]
)
def test_sustainable_leaves_spare_apples_of_a_patch(policy, spare, left, paint_over):
    quirks = only_quirks(paint_over=paint_over)
    scene = Scene(CROSS, policy, worlds=8, spare=spare, may_fire=False, quirks=quirks)
    scene.go(200)
    assert scene.env.output.stock[:, 0].tolist() == [left] * 8


@pytest.mark.parametrize("paint_over", [False, True])
def test_sustainable_does_not_walk_over_an_apple_that_it_spares_not_even_under_its_own_mark(paint_over):
    quirks = only_quirks(paint_over=paint_over)
    scene = Scene(">.A..", "sustainable", worlds=8, may_fire=False, quirks=quirks)
    scene.go(100)
    assert scene.bitten == 0
    assert scene.env.worlds.now.col[:, 0].max() == 1


@pytest.mark.parametrize(
    ("drawing", "policy", "fires"),
    [
        (">..<A", "territorial", True),
        (">..<.A", "territorial", True),
        (">..<..A", "territorial", False),
        (">.#<A", "territorial", False),
        (">.....<A", "territorial", False),
        (">..<A", "greedy", False),
        (">..<A", "pacifist", False),
        (">..<A", "sustainable", False),
        (">..<..A", "aggressive", True),
        (">....<A", "aggressive", True),
        (">.....<A", "aggressive", False),
        (">.#<..A", "aggressive", False),
        (".>...\n...<A", "territorial", True),
        (".>...\n.....\n...<A", "territorial", False),
    ],
)
def test_which_policies_fire_at_which_agents(drawing, policy, fires):
    scene = Scene(drawing, policy, window_rows=8, window_columns=9)
    assert (scene.go(1) == ["beam"]) == fires
    assert scene.in_play[1] != fires, "and the beam hits"


@pytest.mark.parametrize(
    ("drawing", "policy", "rules", "fires"),
    [
        (">......\n.....<.\nA......", "aggressive", {}, True),
        (">......\n.....<.\nA......", "aggressive", {"beam_tapers": True}, False),
        (">......\n....<..\nA......", "aggressive", {"beam_tapers": True}, True),
        (">....<.\n.......\nA......", "aggressive", {"beam_tapers": True}, True),
        (">......\n<......\nA......", "aggressive", {}, False),
        (">......\n<......\nA......", "aggressive", {"beam_from_beside": True}, True),
        (">......\n#.<....\nA......", "aggressive", {"beam_from_beside": True}, False),
        (">.<.<A.", "territorial", {}, True),
        (">.<...<A", "territorial", {"beam_stops_at_agents": True, "beam_length_cells": 6}, False),
    ],
)
def test_agents_fire_where_the_beam_of_the_game_hits(drawing, policy, rules, fires):
    scene = Scene(drawing, policy, window_rows=8, window_columns=9, **rules)
    assert (scene.go(1) == ["beam"]) == fires
    assert all(scene.in_play) != fires, "and the beam hits"


def test_aggressive_turns_to_an_agent_at_its_side_walks_towards_it_and_fires():
    scene = Scene(".A......\n^......<", "aggressive", window_rows=8, window_columns=17)
    assert scene.go(4) == ["turn_right", "forward", "forward", "beam"]
    assert scene.in_play == [True, False]
    assert scene.board == drawn(".A......\n..>.....")


def test_aggressive_harvests_if_it_sees_no_agent():
    scene = Scene(".>.A.\n<....", "aggressive", window_columns=1)
    assert scene.go(2) == ["forward", "forward"]
    assert scene.bitten == 1


@pytest.mark.parametrize(("policy", "goes"), [("greedy", 1.0), ("pacifist", 0.0)])
def test_pacifist_leaves_an_apple_that_another_agent_is_nearer_to(policy, goes):
    scene = Scene("^..A.<\n......", policy, worlds=64)
    steps = scene.env.rollout(1, scene.policy)
    went = (steps["agents", "action"][:, 0, 0] == ACTIONS.index("right")).double().mean()
    assert went == goes


def test_an_agent_harvests_in_its_region_alone_and_goes_around_other_apples():
    drawing = "A...A\n..A..\n..^.."
    assert Scene(drawing, "greedy", may_fire=False).go(1) == ["forward"]
    scene = Scene(drawing, "greedy", worlds=16, region=(0, 2), may_fire=False)
    scene.go(1)
    assert scene.bitten == 0
    assert scene.env.worlds.now.row[:, 0].min() == 2, "it turns before the apple ahead"
    scene = Scene("A.A.\n..^.", "greedy", region=(2, 0), may_fire=False)
    assert scene.go(2)[0] == "forward"
    scene = Scene("....A\n.##..\n^#A..", "sustainable", spare=1, region=(1, 2), worlds=8, may_fire=False)
    scene.go(60)
    assert scene.env.output.stock[:, 0].tolist() == [2] * 8, "neither has one near it"


@pytest.mark.parametrize(
    ("policy", "tag", "fires"),
    [
        ("greedy", (1,), True),
        ("greedy", (2,), False),
        ("greedy", (), False),
        ("aggressive", (2, 1), True),
        ("aggressive", (2,), False),
        ("aggressive", (), False),
        ("territorial", (1,), True),
        ("territorial", (2,), False),
        ("pacifist", (1, 2), True),
    ],
)
def test_an_agent_fires_at_those_whom_it_is_to_tag(policy, tag, fires):
    scene = Scene(">..<A..\n......<", policy, tag=tag, window_rows=8, window_columns=9)
    assert (scene.go(1) == ["beam"]) == fires
    assert scene.in_play == [True, not fires, True]


def test_aggressive_pursues_those_whom_it_is_to_tag():
    scene = Scene(".A......\n^..<...<", "aggressive", tag=(2,), window_rows=8, window_columns=17)
    assert scene.go(1) == ["turn_right"]
    scene = Scene(".A..\n^..<", "aggressive", tag=(), window_rows=8, window_columns=17)
    assert scene.go(2) == ["forward", "right"], "of whom there is none"


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"region": (3, 0)}, r"region is \(3, 0\); allowed: \(an integer in 0..2, an integer in 0..1\)"),
        ({"region": (0, 2)}, r"region is \(0, 2\)"),
        ({"region": (1,)}, "region"),
        ({"tag": (1,)}, r"tag is \(1,\); allowed without a beam and Observation.agents_apart: \(\)"),
        ({"tag": (2,)}, r"tag is \(2,\); allowed: \(an integer in 0..1, ...\)"),
    ],
)
def test_a_region_beyond_the_window_and_agents_that_are_not_there_or_look_alike_are_refused(numbers, words):
    game = Game(map=maps.parse(">.A\n<.."), rules=Rules(window_rows=3, window_columns=3))
    with pytest.raises(ValueError, match=words):
        ScriptedActor(Plan("greedy", **numbers), game, seeds=[(0,)], agents=1)


def test_two_agents_that_want_one_cell_wait_at_random_until_one_gets_it():
    game = Game(map=maps.parse(">A<\n#.#"), rules=Rules(regrow_prob=(0.0,)))
    seeds = [(0, lane) for lane in range(20)]
    actor = ScriptedActor(Plan("greedy"), game, seeds=seeds, agents=2)
    ends = evaluate(CommonsEnv(game, 10, seed=0), JointPolicy({(0, 1): actor}))
    harvest = np.array([episode.harvest for episode in ends])
    assert harvest.sum(1).tolist() == [1] * 10
    assert 0 < harvest[:, 0].sum() < 10, "not always the same agent"
    assert max(episode.steps for episode in ends) > 1


def test_agents_that_wait_stay_also_where_they_may_clean():
    scene = Scene("~~~~\n>A<.", "greedy", worlds=64, river=River(may_clean=True))
    chosen = scene.policy(scene.env.reset())["agents", "action"][:, 0].tolist()
    assert {scene.game.actions[action] for action in chosen} == {"forward", "stay"}


def population(policy, game, worlds, seed=0):
    seeds = [(seed, agent) for agent in range(game.agents)]
    actor = ScriptedActor(Plan(policy), game, seeds=seeds, agents=game.agents, worlds=worlds)
    return evaluate(CommonsEnv(game, worlds, seed=seed), JointPolicy({tuple(range(game.agents)): actor}))


def mean(episodes, name):
    return float(np.mean([np.sum(getattr(episode, name)) for episode in episodes]))


@pytest.mark.integration
def test_a_single_greedy_agent_harvests_far_more_than_a_random_one():
    game = presets.game("single_basic")
    returns = {policy: mean(population(policy, game, 8), "return_") for policy in ("random", "greedy")}
    assert returns["greedy"] > 1.5 * returns["random"], returns


def test_on_commons_greedy_agents_deplete_the_stock_and_sustainable_agents_do_not():
    played = {name: population(name, presets.game("commons"), 3) for name in ("greedy", "sustainable")}
    assert [episode.stock_left for episode in played["greedy"]] == [0, 0, 0]
    assert max(episode.steps for episode in played["greedy"]) < 400
    assert min(episode.stock_left for episode in played["sustainable"]) > 30
    assert [episode.steps for episode in played["sustainable"]] == [1000] * 3
    assert mean(played["sustainable"], "return_") > 3 * mean(played["greedy"], "return_")


def test_aggressive_agents_tag_more_than_territorial_ones_and_pacifists_never_fire():
    game = presets.game("commons")
    game = replace(game, rules=replace(game.rules, episode_steps=200))
    played = {name: population(name, game, 4) for name in ("aggressive", "territorial", "pacifist")}
    tagged = {name: mean(episodes, "tagged") for name, episodes in played.items()}
    assert tagged["aggressive"] > tagged["territorial"] > tagged["pacifist"] == 0
    assert mean(played["pacifist"], "shots") == 0


FORMS = [
    Observation(),
    Observation(encoding="one_hot"),
    Observation(agents_apart=True),
    Observation(encoding="one_hot", agents_apart=True, stock_gauge=True),
    Observation(scoreboard=True, stock_gauge=True),
]


@pytest.mark.parametrize("may_fire", [True, False])
@pytest.mark.parametrize("policy", SCRIPTED_POLICIES)
def test_actions_do_not_depend_on_the_form_of_the_observation(policy, may_fire):
    walled = maps.parse("A.A.#.A\n.>A.#AA\nA..v.A.\n..#A.<.")
    rules = Rules(may_fire=may_fire, window_rows=4, window_columns=7)
    courses = []
    for form in FORMS:
        game = Game(map=walled, rules=rules, observation=form)
        actor = ScriptedActor(Plan(policy), game, seeds=[(1, lane) for lane in range(9)], agents=3)
        agents, env = JointPolicy({(0, 1, 2): actor}), CommonsEnv(game, 3, seed=0)
        courses.append(env.rollout(40, agents, break_when_any_done=False)["agents", "action"])
    assert courses[0].max() < len(game.actions)
    assert courses[0].unique().numel() > 3
    for course in courses[1:]:
        assert torch.equal(course, courses[0])


def windows(game, worlds):
    """The observations of B worlds after some turns of random play, [B, N, C, X, Y]."""
    return CommonsEnv(game, worlds, seed=0).rollout(15)["next", "agents", "observation"][:, -1].contiguous()


@pytest.mark.parametrize("policy", SCRIPTED_POLICIES)
def test_the_actions_of_a_lane_do_not_depend_on_other_lanes(policy):
    game = presets.game("commons")
    seen = windows(game, 6)  # 2 replicas x 3 worlds, of which agents 1 and 3
    seeds = [(5, replica, agent) for replica in range(2) for agent in (1, 3)]
    everyone = ScriptedActor(Plan(policy), game, seeds=seeds, agents=2, worlds=3)
    everyone.epsilon = 0.3
    together = [everyone.choose(seen[:, [1, 3]]) for _ in range(30)]
    for lane, seed in enumerate(seeds):
        replica, agent = divmod(lane, 2)
        alone = ScriptedActor(Plan(policy), game, seeds=[seed], agents=1, worlds=3)
        alone.epsilon = 0.3
        own = slice(3 * replica, 3 * replica + 3)
        for chosen in together:
            expected = alone.choose(seen[own, [[1], [3]][agent]])
            assert torch.equal(chosen[own, agent], expected[:, 0])


@pytest.mark.integration
def test_epsilon_is_the_probability_of_a_random_action_while_exploring():
    game = Game(map=maps.parse("A..\n...\n^.."), rules=Rules())
    actor = ScriptedActor(Plan("greedy"), game, seeds=[(lane,) for lane in range(4000)], agents=1)
    seen = CommonsEnv(game, 4000, seed=0).reset()["agents", "observation"]
    actor.epsilon = 0.4
    counts = torch.bincount(actor.choose(seen)[:, 0], minlength=8)
    assert abs(int(counts[1:].sum()) - 4000 * 0.4 * 7 / 8) < 5 * (4000 * 0.35 * 0.65) ** 0.5
    assert counts[1:].min() > 120
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.bincount(actor.choose(seen)[:, 0], minlength=8).tolist() == [4000, *[0] * 7]


def test_an_actor_continues_from_the_state_of_another():
    game = presets.game("two_complex")
    seen = windows(game, 2)

    def made():
        return ScriptedActor(Plan("random"), game, seeds=[(0, lane) for lane in range(4)], agents=2)

    one, other = made(), made()
    for _ in range(7):
        one.choose(seen)
    other.load_state_dict(one.state_dict())
    ahead = [[actor.choose(seen) for _ in range(2000)] for actor in (one, other)]
    assert all(map(torch.equal, *ahead))


def test_a_game_whose_observations_are_no_windows_is_refused():
    game = replace(presets.game("commons"), observation=Observation(area="full"))
    with pytest.raises(ValueError, match=r"Observation\.area is 'full'"):
        ScriptedActor(Plan("greedy"), game, seeds=[(0,)], agents=1)
