"""Agents whose plans a language model makes: what it is shown, when it is asked, what its agents then do."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from language_runs import GAME, RULES, language
from matrix_game import MatrixGame
from model_server import served

from cprl import CommonsEnv, Fresh, Game, Observation, maps
from cprl.envs import spaces_of
from cprl.evaluation.populations import play_population
from cprl.institutions import Quota
from cprl.measuring.playing import turns
from cprl.policies.asking import Calls
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.language import LanguageActor
from cprl.policies.rng import Purpose, lane_seeds
from cprl.policies.scripted import Plan, ScriptedActor, scripted_lanes
from cprl.population import Scripted
from cprl.values import from_config, to_config

GREEDY = '{"policy": "greedy"}'


def actor_for(game, spec, *, worlds=1):
    agents = range(game.agents)
    seeds = lane_seeds(1, replicas=[0], agents=agents, purpose=Purpose.EVALUATION)
    return LanguageActor(spec, game, calls=Calls(), seeds=seeds, agents=game.agents, worlds=worlds)


def played(game, actor, worlds=1):
    policy = JointPolicy({tuple(range(game.agents)): actor})
    batches = [batch.clone() for batch in turns(CommonsEnv(game, worlds, seed=2), policy)]
    return torch.stack([batch["agents", "action"] for batch in batches])


def prompts(server):
    return [request["messages"][1]["content"] for request in server.requests]


def test_a_plan_of_a_scripted_policy_is_that_policy():
    agents = range(GAME.agents)
    seeds = lane_seeds(1, replicas=[0], agents=agents, purpose=Purpose.EVALUATION)
    for policy in ("greedy", "aggressive"):
        with served(lambda request, policy=policy: json.dumps({"policy": policy})) as server:
            planned = played(GAME, actor_for(GAME, language(server.url), worlds=2), worlds=2)
        script = scripted_lanes(policy, GAME, seeds=seeds, agents=GAME.agents, worlds=2)
        assert torch.equal(planned, played(GAME, script, worlds=2))


def test_agents_of_one_turn_follow_plans_of_their_own():
    board = Game(map=maps.parse("#####\n#A.A#\n#^#^#\n#####"), rules=RULES)  # each sees an apple ahead
    answers = iter(['{"policy": "sustainable", "spare": 8}', GREEDY])
    with served(lambda request: next(answers, GREEDY)) as server:
        actions = played(board, actor_for(board, language(server.url, concurrency=1)))
    names = [board.actions[action] for action in actions[0, 0].tolist()]
    assert names[0] != "forward"
    assert names[1] == "forward", "the greedy one goes for its apple"


def test_a_model_is_asked_every_so_many_steps():
    game = Game(map=maps.parse("A>..\n...."), rules=replace(RULES, plays_on_when_empty=True))
    with served(lambda request: GREEDY) as server:
        played(game, actor_for(game, language(server.url, every_steps=10)))
        first, second, third = prompts(server)
    assert first.startswith("Turn 1 of 25. You picked 0 apples so far.\nWhat you see")
    assert second.startswith("Turn 11 of 25. You picked 1 apples so far.\nYour last plan: greedy, spare 3.")
    assert third.startswith("Turn 21 of 25.")


def test_nobody_is_asked_in_a_world_whose_episode_is_over_while_others_play():
    game = Game(map=maps.parse("A...>.\n......"), rules=RULES)
    with served(lambda request: GREEDY) as server:
        actor = actor_for(game, language(server.url, every_steps=1), worlds=4)
        policy = JointPolicy({(0,): actor})
        batches = [batch.clone() for batch in turns(CommonsEnv(game, 4, seed=2), policy)]
        is_over = torch.stack([batch["next", "done"] for batch in batches])[..., 0]
        steps = (~is_over).sum(0) + 1
        assert len(set(steps.tolist())) > 1, "they end apart"
        assert len(server.requests) == int(steps.clamp(max=len(batches)).sum())


def test_an_agent_that_is_tagged_out_is_asked_when_it_is_back():
    game = Game(map=maps.parse("A.......\n>.<....."), rules=RULES)
    with served(lambda request: '{"policy": "aggressive"}') as server:
        actor = actor_for(game, language(server.url, every_steps=1))
        policy = JointPolicy({(0, 1): actor})
        batches = [batch.clone() for batch in turns(CommonsEnv(game, 1, seed=2), policy)]
    in_play = torch.stack([batch["agents", "in_play"] for batch in batches])
    assert not in_play.all(), "they tag each other"
    assert len(server.requests) == int(in_play.sum())


def test_a_model_is_shown_the_rules_and_all_that_its_agent_observes():
    game = Game(
        map=maps.parse("A#A.A\n.>.<."),
        rules=replace(RULES, signals=2, may_fire=False),
        observation=Observation(scoreboard=True, stock_gauge=True),
        institutions=(Quota(share=0.5, window_steps=12),),
    )
    with served(lambda request: '{"policy": "greedy", "signal": 2}') as server:
        spec = language(server.url, every_steps=5, instructions="You never lie.")
        actions = played(game, actor_for(game, spec))
    system = server.requests[0]["messages"][0]["content"]
    assert system.startswith("You never lie.\nYou are one of 2 agents on a board.\nAgents pick apples.")
    assert "Each agent may pick at most" in system
    assert '"signal" is 0 to 2' in system
    assert '- "sustainable": as greedy' in system
    first, second = prompts(server)[0], prompts(server)[-1]
    assert "Of all places for apples 100% have one." in first
    assert "Apples picked by you and the next agents: 0, 0." in first
    assert "quota left 0:" in first
    assert "@" in first.splitlines()[-1]
    assert "Signal 2 was sent by 1 of those you see." in "\n".join(prompts(server))
    assert "signal 2." in second
    assert (actions >= 2 * game.tables.silent_actions).all()


@pytest.mark.parametrize(
    "answer",
    [
        "no",
        '{"policy": "cunning"}',
        '{"policy": "greedy", "spare": 9}',
        '{"policy": "greedy", "spare": 1.5}',
        '{"policy": "greedy", "signal": 1}',
        '{"policy": "greedy", "whom": 1}',
        '{"policy": "greedy", "region": [3, 1]}',
        '{"policy": "greedy", "region": [1]}',
        '{"policy": "greedy", "region": [-1, 1]}',
        '{"policy": "greedy", "tag": [1]}',
        '{"policy": "greedy", "message": "pick less"}',
        '{"policy": ["greedy"]}',
        '{"policy": {"kind": "Custom", "target": "os:getcwd"}}',
        '{"spare": 1}',
        '{"policy": "greedy", "spare": 1e999}',
    ],
)
def test_a_plan_that_is_not_allowed_is_the_fallback_that_was_said(answer):
    agents = range(GAME.agents)
    seeds = lane_seeds(1, replicas=[0], agents=agents, purpose=Purpose.EVALUATION)
    with served(lambda request: answer) as server:
        actor = actor_for(GAME, language(server.url, fallback="aggressive"))
        fallen = played(GAME, actor)
        assert len(server.requests) > 1
        assert f"{len(server.requests)} without a usable answer" in actor._calls.in_words()
    script = scripted_lanes("aggressive", GAME, seeds=seeds, agents=GAME.agents)
    assert torch.equal(fallen, played(GAME, script))


def test_a_plan_says_where_an_agent_harvests_and_whom_it_tags():
    board = Game(
        map=maps.parse("...A.\n..A..\n>.<.>\n.....\n..^..\n....A"),
        rules=replace(RULES, window_rows=5, beam_length_cells=4),
        observation=Observation(agents_apart=True),
    )
    plan = {"policy": "aggressive", "region": [2, 0], "tag": [1]}
    with served(lambda request: json.dumps(plan)) as server:
        actor = actor_for(board, language(server.url))
        planned = played(board, actor)
        system = server.requests[0]["messages"][0]["content"]
        assert '"region": [4, 2], "tag": [1]}' in system
        assert "0 agent_0, 1 agent_1" in prompts(server)[0]
        assert "Your last plan: aggressive, spare 3, region 2, 0, tag [1]." in prompts(server)[-1]
    seeds = lane_seeds(1, replicas=[0], agents=range(4), purpose=Purpose.EVALUATION)
    script = ScriptedActor(Plan("aggressive", region=(2, 0), tag=(1,)), board, seeds=seeds, agents=4)
    assert torch.equal(planned, played(board, script))
    assert not torch.equal(
        planned, played(board, ScriptedActor(Plan("aggressive"), board, seeds=seeds, agents=4))
    )
    for region, tag in (([5, 0], [1]), ([0, 3], [1]), ([0, 0], [4])):
        with pytest.raises(ValueError, match="allowed"):
            actor._read({"policy": "greedy", "region": region, "tag": tag})


def test_a_message_is_read_by_all_other_agents_of_the_world_from_the_next_turn_on_and_in_its_episode_alone():
    game = replace(GAME, rules=replace(RULES, signals=1, episode_steps=9, plays_on_when_empty=True))
    seeds = lane_seeds(1, replicas=[0, 1], agents=range(4), purpose=Purpose.EVALUATION)

    def answer(request):
        return json.dumps({"policy": "greedy", "message": f"</script>\n{request['seed']}"})

    with served(answer) as server:
        calls = Calls()
        said = {}
        actors = {
            agents: LanguageActor(
                language(server.url, every_steps=every_steps),
                game,
                calls=calls,
                seeds=[seed for seed in seeds if seed[2] in agents],
                agents=len(agents),
                worlds=2,
                said=said,
            )
            for agents, every_steps in (((0, 2), 2), ((1, 3), 3))
        }
        env = CommonsEnv(game, 4, seed=2)
        for _ in range(2):
            list(turns(env, JointPolicy(actors)))
    by_turn = {}  # replica and world, agent, episode and turn -> what was read, what was said
    for call in calls.kept.values():
        place, _, number = call["call"].partition(", agent ")
        agent, number = number.split(", call ")
        prompt = call["request"]["messages"][1]["content"]
        heard = prompt[: prompt.index("Turn ")].splitlines()
        assert heard[0] == f"You are agent {agent}."
        turn = int(prompt[prompt.index("Turn ") :].split()[1])
        every_steps = 2 if int(agent) % 2 == 0 else 3
        episode = int(number) // -(-9 // every_steps)
        by_turn[place, int(agent), episode, turn] = heard[1:], json.loads(call["answer"])["message"]
    assert len(by_turn) == 4 * 2 * (2 * 5 + 2 * 3)
    for (place, listener, episode, turn), (heard, _) in by_turn.items():
        expected = []
        for agent in {0, 1, 2, 3} - {listener}:
            earlier = [
                (when, message)
                for (where, speaker, which, when), (_, message) in by_turn.items()
                if (where, speaker, which) == (place, agent, episode) and when < turn
            ]
            if earlier:
                expected.append(f"Agent {agent} says: {json.dumps(max(earlier)[1])}")
        assert heard == expected


def test_language_agents_play_beside_others_in_fresh_worlds_and_are_what_they_were_when_asked_again():
    tables = []
    for _ in range(2):
        with served() as server:
            agents = (language(server.url), Scripted("greedy"), language(server.url), Scripted())
            tables.append(play_population(GAME, agents, Fresh(episodes=2, replicas=(0, 1))))
            assert {len(request["messages"]) for request in server.requests} == {2}
    assert tables[0].equals(tables[1])
    assert len(np.unique(tables[0]["replica"])) == 2


def test_in_a_game_without_a_board_it_is_shown_numbers_and_answers_an_action():
    env = MatrixGame(1)
    seeds = lane_seeds(1, replicas=[0], agents=range(2), purpose=Purpose.EVALUATION)
    with served(lambda request: '{"action": 1}') as server:
        spec = language(server.url, every_steps=1, fallback="random", instructions="A dilemma.")
        actor = LanguageActor(spec, spaces_of(env), calls=Calls(), seeds=seeds, agents=2)
        batches = [batch.clone() for batch in turns(env, JointPolicy({(0, 1): actor}))]
        assert len(server.requests) == 2 * 5
        system = server.requests[0]["messages"][0]["content"]
        assert system.startswith("A dilemma.\nYou choose an action each turn.")
        assert "an integer from 0 to 1" in system
        assert prompts(server)[0] == "Turn 1. You observe: 0 0 0 0"
        assert prompts(server)[-1] == "Turn 5. Your last action: 1. You observe: 0 0 0 1"
    assert all((batch["agents", "action"] == 1).all() for batch in batches)
    for answer in ('{"action": 2}', '{"action": "defect"}', '{"action": true}', "1"):
        with served(lambda request, answer=answer: answer) as server:
            spec = language(server.url, fallback="random")
            actor = LanguageActor(spec, spaces_of(env), calls=Calls(), seeds=seeds, agents=2)
            fallen = [batch["agents", "action"].clone() for batch in turns(env, JointPolicy({(0, 1): actor}))]
            random = scripted_lanes("random", spaces_of(env), seeds=seeds, agents=2)
            assert len(server.requests) == 2
        played_at_random = turns(env, JointPolicy({(0, 1): random}))
        assert torch.equal(
            torch.stack(fallen), torch.stack([batch["agents", "action"] for batch in played_at_random])
        )
    with pytest.raises(ValueError, match="'random'"):
        LanguageActor(language(), spaces_of(env), calls=Calls(), seeds=seeds, agents=2)


def test_a_language_agent_is_a_value_in_a_recipe():
    spec = language(key_variable="A_KEY")
    assert from_config(to_config(spec)) == spec
    with pytest.raises(ValueError, match=r"Language\.fallback"):
        language(fallback="cunning")
    with pytest.raises(ValueError, match=r"Language\.every_steps"):
        language(every_steps=0)
