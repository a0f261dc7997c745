"""A lawgiver reads what came of a game, and its law is read and refused like any other."""

import json
from dataclasses import replace

import pytest
from language_runs import GAME, language
from model_server import plan, served

from cprl import Fresh
from cprl.evaluation.populations import play_population
from cprl.experimental.lawgiver import Lawgiver
from cprl.institutions import Quota, Tax
from cprl.policies.asking import CALLS, Calls, read_calls
from cprl.population import Scripted

QUOTA = {"kind": "Quota", "share": 0.5, "window_steps": 24}


@pytest.fixture(scope="module")
def table():
    return play_population(GAME, (Scripted("greedy"),) * 4, Fresh(episodes=1, replicas=(0,)))


def given(answer, table, game=GAME):
    with served(lambda request: answer) as server:
        calls = Calls()
        law = Lawgiver(model="small", base_url=server.url, retries=0, instructions="Be fair.")
        return law.give(game, table, calls), server.requests, calls


def test_a_law_replaces_the_institutions_of_a_game(table):
    answer = {"why": "few apples are left", "institutions": [QUOTA, {"kind": "Tax", "rate": 0.1}]}
    taxed = replace(GAME, institutions=(Tax(rate=0.9),))
    game, (request,), _ = given(json.dumps(answer), table, taxed)
    assert game.institutions == (Quota(share=0.5, window_steps=24), Tax(rate=0.1))
    system, prompt = (message["content"] for message in request["messages"])
    assert system.startswith("Be fair.\nYou give laws to 4 agents on a board.")
    assert "- Quota: observed, True or False (True); share, a number in 0..1e+06 (1);" in system
    assert prompt.startswith("Institutions now: tax (rate 0.9).\nWhat came of it:\n")
    assert "- collective_return: " in prompt
    assert given('{"institutions": []}', table, taxed)[0].institutions == ()


@pytest.mark.parametrize(
    "institutions",
    [
        [{"kind": "Quota", "share": -1}],
        [{"kind": "Kindness"}],
        [{"kind": "DQN"}],
        [{"kind": "Custom", "target": "os:getcwd", "arguments": {}}],
        ["Quota"],
        QUOTA,
        [QUOTA, QUOTA, {"kind": "Boundaries"}],
        None,
        3,
    ],
)
def test_a_law_that_is_not_allowed_leaves_the_game_as_it_is_and_is_kept(institutions, table):
    game, requests, calls = given(json.dumps({"institutions": institutions}), table)
    assert game is GAME
    assert len(requests) == 1
    assert next(iter(calls.kept.values()))["failure"]


def test_rounds_of_play_and_law_replay_without_a_network(tmp_path):
    def rounds(model, law, calls):
        game, played = GAME, []
        for number in range(2):
            played.append(play_population(game, (model,) * 4, Fresh(episodes=1, seed=number, replicas=(0,))))
            game = law.give(game, played[-1], calls, number=number)
        return game, played

    def answer(request):
        is_law = "You give laws" in request["messages"][0]["content"]
        return json.dumps({"institutions": [QUOTA]}) if is_law else plan(request)

    first = Calls()
    first.keep_in(tmp_path / CALLS)
    with served(answer) as server:
        law = Lawgiver(model="small", base_url=server.url, retries=0)
        game, played = rounds(language(server.url), law, first)
        again = Calls()
        again.keep_in(tmp_path / CALLS)
        before = len(server.requests)
        same, replayed = rounds(language(server.url), law, again)
        asked_for_laws = [one for one in server.requests[before:] if "give laws" in str(one)]
    assert game.institutions == same.institutions == (Quota(share=0.5, window_steps=24),)
    assert [one.equals(other) for one, other in zip(played, replayed, strict=True)] == [True, True]
    assert asked_for_laws == []
    assert [call["call"] for call in read_calls(tmp_path / CALLS).values()] == ["law 0", "law 1"]
