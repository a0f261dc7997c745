"""Games that Python and the page both play; tests/web/games.json holds them, play_held.js plays them."""

import hashlib
import json
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch

from cprl import CommonsEnv, Game, Rules, maps, presets
from cprl.commons import chance
from cprl.institutions import Quota
from cprl.policies.rng import Purpose, lane_seeds
from cprl.policies.scripted import Plan, ScriptedActor
from cprl.web.playable import playable

EVERY = 100
"""The turns between two digests."""
WORD = 2**32


@dataclass(frozen=True, kw_only=True)
class Case:
    """Worlds of a game with one seed, all with the same agents; world n is replica n with one world."""

    game: Game
    policies: tuple[str, ...] | None
    """The policy of each agent; None for agents that do as `moves` says."""
    seed: int
    first_world: int = 0
    worlds: int = 1
    episodes: int = 1


def moves(turn, agents, actions):
    """The actions of agents that walk about, turn and fire, two times of three forward."""
    numbers = (turn * 64 + np.arange(agents) + 1) * 0x9E3779B1 % WORD
    words = ((numbers ^ 0x5BD1E995) * 0x85EBCA6B % WORD) >> 8
    return np.where(words % 3 == 0, (words >> 8) % actions, 0)


def actors_of(case):
    """A scripted actor for each policy, and the agents that follow it."""
    replicas = range(case.first_world, case.first_world + case.worlds)
    actors = []
    for policy in dict.fromkeys(case.policies or ()):
        agents = [i for i, name in enumerate(case.policies) if name == policy]
        seeds = lane_seeds(case.seed, replicas=replicas, agents=agents, purpose=Purpose.EVALUATION)
        actors.append((agents, ScriptedActor(Plan(policy), case.game, seeds=seeds, agents=len(agents))))
    return actors


def chosen(case, actors, observation, turn):
    """The actions of all agents, int64 [B, N]."""
    shape = case.worlds, case.game.agents
    actions = torch.zeros(shape, dtype=torch.int64)
    if case.policies is None:
        return actions + torch.from_numpy(moves(turn, case.game.agents, len(case.game.actions)))
    for agents, actor in actors:
        actions[:, agents] = actor.choose(observation[:, agents])
    return actions


def states(env):
    """The state of each world in a turn, int32 [B, numbers], as `bytesOf` of play_held.js."""
    now = env.worlds.now
    agents = [now.row, now.col, now.heading, now.in_play, env.output.fired, env.output.harvest]
    parts = [*agents, now.stock_left, now.ended, now.stock]
    return np.concatenate(parts, 1, dtype=np.int32, casting="unsafe")


def played(case, every=EVERY):
    """The turns of each world's episodes, and digests of all that happened so far."""
    env = CommonsEnv(case.game, case.worlds, seed=case.seed, first_world=case.first_world, threads=1)
    actors = actors_of(case)
    hashes = [hashlib.sha256() for _ in range(case.worlds)]
    turns = [[] for _ in hashes]
    digests = [[] for _ in hashes]
    assert case.worlds == 1 or case.episodes == 1, "worlds of a batch begin their episodes together"
    for _ in range(case.episodes):
        data = env.reset()
        for world_hash, state in zip(hashes, states(env), strict=True):
            world_hash.update(state.tobytes())
        ended = np.zeros(case.worlds, np.bool_)
        turn = 0
        while not ended.all():
            data["agents", "action"] = chosen(case, actors, data["agents", "observation"], turn)
            data = env.step(data)["next"]
            turn += 1
            done = data["done"].reshape(-1).numpy()
            now = states(env)
            for world in np.flatnonzero(~ended):
                hashes[world].update(now[world].tobytes())
                if turn % every == 0 or done[world]:
                    digests[world].append(hashes[world].hexdigest()[:8])
                if done[world]:
                    turns[world].append(turn)
            ended = ended | done
    return turns, digests


def held(cases, every=EVERY) -> dict[str, Any]:
    """What play_held.js reads: the games of cases by name, and what was played."""
    specs = {}
    games = []
    for name, case in cases.items():
        specs[name] = playable(case.game)
        for world, (turns, digests) in enumerate(zip(*played(case, every), strict=True)):
            games.append(
                {
                    "game": name,
                    "policies": case.policies,
                    "seed": str(case.seed),
                    "world": case.first_world + world,
                    "episodes": case.episodes,
                    "turns": turns,
                    "digests": digests,
                }
            )
    return json.loads(json.dumps({"every": every, "specs": specs, "games": games}))


def commons(*institutions, board="commons", **rules):
    game = presets.game(board)
    return replace(game, rules=replace(game.rules, **rules), institutions=institutions)


def walled(**rules):
    """A board with walls inside, on which beams and paths end."""
    drawing = """
        .A.#.AA...A
        >AA#..A.#.A
        .A.v.A..#AA
        .#.A..#^.A.
        AA..#A..AA<
    """
    return Game(map=maps.parse(drawing), rules=Rules(window_rows=4, window_columns=7, **rules))


def grown(above):
    """One agent picks the only apple; whether another grows in turn 2 hangs on the last bit of a word."""
    game = Game(map=maps.parse(".>A.."), rules=Rules(regrow_prob=(0.5,), episode_steps=20))
    words = word_of(seed=4, turn=2, site=0)
    return replace(game, rules=replace(game.rules, regrow_prob=((words + above) / WORD,)))


def word_of(*, seed, turn, site):
    """The word that decides whether a site grows an apple in the first episode of world 0."""
    first, rest = (
        chance.philox4x32(*map(np.uint64, (number, turn, 0, 0, seed, 0)))[place]
        for number, place in ((chance.REGROWTH_FIRST_BYTE, site >> 2), (chance.REGROWTH_REST + site, 0))
    )
    return ((int(first) >> 8 * (site & 3)) & 255) << 24 | int(rest) >> 8


def whole_number():
    """A quota that computes to 5.999999999999999 apples, and allows six."""
    unit = float(commons(Quota()).law_parameters["quotas"]["window_yield"][0])
    share = 6 / unit
    while share * unit >= 6:
        share = float(np.nextafter(share, 0))
    return commons(Quota(share=share), episode_steps=200)


GREEDY, SUSTAINABLE, TERRITORIAL, AGGRESSIVE, PACIFIST = (
    (policy,) * 4 for policy in ("greedy", "sustainable", "territorial", "aggressive", "pacifist")
)
MIXED = ("aggressive", "sustainable", "random", "pacifist")


@cache
def cases():
    """The held games by name; those up to "quota at the end" are played in the default suite."""
    quota = Quota(share=0.25)
    return {
        "word at threshold": Case(game=grown(0), policies=("greedy",), seed=4),
        "word below threshold": Case(game=grown(1), policies=("greedy",), seed=4),
        "whole quota": Case(game=whole_number(), policies=GREEDY, seed=20, worlds=2),
        "walls": Case(game=walled(), policies=MIXED[::-1], seed=2**63 - 9, first_world=2**32 - 3, worlds=2),
        "quota at the end": Case(game=commons(quota, episode_steps=200), policies=GREEDY, seed=21),
        "greedy": Case(game=commons(), policies=GREEDY, seed=1, worlds=4),
        "sustainable": Case(game=commons(), policies=SUSTAINABLE, seed=2**53 + 1, worlds=4),
        "two hold back": Case(game=commons(), policies=GREEDY[:2] + SUSTAINABLE[:2], seed=3, worlds=4),
        "two hold back under a quota": Case(
            game=commons(quota), policies=GREEDY[:2] + SUSTAINABLE[:2], seed=4, worlds=4
        ),
        "territorial": Case(game=commons(), policies=TERRITORIAL, seed=5, worlds=2),
        "aggressive": Case(game=commons(), policies=AGGRESSIVE, seed=6, worlds=2),
        "pacifist": Case(game=commons(quota), policies=PACIFIST, seed=7, worlds=2),
        "by stock": Case(
            game=commons(Quota(share=0.5, window_steps=30, by_stock=True)), policies=MIXED, seed=8, worlds=2
        ),
        "moves": Case(game=commons(), policies=None, seed=9, worlds=4),
        "moves among walls": Case(game=walled(hits_to_tag=2), policies=None, seed=10, worlds=4),
        "many beams": Case(
            game=commons(hits_to_tag=2, freeze_steps=0, beam_length_cells=(1, 2, 3, 20), shuffle_starts=True),
            policies=AGGRESSIVE,
            seed=11,
            episodes=3,
        ),
        "another norm": Case(
            game=commons(quota, regrow_norm="manhattan", regrow_radius_cells=3.5, beam_width_cells=5),
            policies=MIXED,
            seed=12,
            episodes=2,
        ),
        "two": Case(game=commons(board="two_complex"), policies=("aggressive", "greedy"), seed=13, worlds=4),
        "one alone": Case(game=commons(board="single_complex"), policies=("greedy",), seed=14, worlds=4),
    }
