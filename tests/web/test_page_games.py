"""The game in JavaScript is `CommonsEnv`: Python and node both play the games of games.json, turn by turn.

`GOLDEN=write python -m pytest tests/web/test_page_games.py -m integration` writes the file anew; say in the
commit why a number moved.
"""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from page_games import Case, cases, commons, held, walled

from cprl import Observation, maps, presets
from cprl.institutions import GraduatedSanctions, Quota, Tax
from cprl.web.playable import playable

HELD = Path(__file__).parent / "games.json"
PLAYER = Path(__file__).parent / "play_held.js"
PLAYED_BY_DEFAULT = [
    "word at threshold",
    "word below threshold",
    "whole quota",
    "walls",
    "quota at the end",
    "greedy",
]
needs_node = pytest.mark.skipif(
    shutil.which("node") is None and "CI" not in os.environ, reason="node is missing, and this is no CI"
)


def in_node(path):
    """The last line of what node says about a file of games, and whether all are equal."""
    done = subprocess.run(["node", PLAYER, path], capture_output=True, text=True, timeout=300, check=False)
    return done.returncode == 0, done.stdout + done.stderr


def assert_python_plays_as_held(names):
    now = held({name: cases()[name] for name in names})
    before = json.loads(HELD.read_text())
    assert now["every"] == before["every"]
    for name in names:
        assert now["specs"][name] == before["specs"][name], name
        games = [[game for game in file["games"] if game["game"] == name] for file in (now, before)]
        assert games[0] == games[1], name


def test_python_plays_as_held():
    assert_python_plays_as_held(PLAYED_BY_DEFAULT)


@pytest.mark.integration
def test_python_plays_all_games_as_held():
    if os.environ.get("GOLDEN") == "write":
        HELD.write_text(
            json.dumps(held(cases()), separators=(",", ":")).replace('{"game"', '\n{"game"') + "\n"
        )
    assert set(json.loads(HELD.read_text())["specs"]) == set(cases()), "each case is held"
    assert_python_plays_as_held([name for name in cases() if name not in PLAYED_BY_DEFAULT])


@needs_node
def test_javascript_plays_as_held():
    are_equal, said = in_node(HELD)
    assert are_equal, said
    assert said.endswith(" 0 unequal\n")


@needs_node
def test_a_game_that_differs_in_one_number_is_found(tmp_path):
    file = json.loads(HELD.read_text())
    file["games"] = [game for game in file["games"] if game["game"] == "word at threshold"]
    file["specs"]["word at threshold"]["regrow_below"][0] += 1
    changed = tmp_path / "changed.json"
    changed.write_text(json.dumps(file))
    are_equal, said = in_node(changed)
    assert not are_equal
    assert "game word at threshold, seed 4, world 0, greedy: unequal from digest 0" in said


def random_cases(rng):
    """Ten games with rules drawn by chance, each in 20 worlds."""
    policies = ["greedy", "sustainable", "territorial", "aggressive", "pacifist", "random"]
    for number in range(10):
        rules = {
            "regrow_prob": tuple(np.sort(rng.random(4) * 0.1).tolist()),
            "regrow_radius_cells": float(rng.choice([1, 2, 2.5, 3])),
            "regrow_norm": str(rng.choice(["euclidean", "manhattan", "chebyshev"])),
            "beam_length_cells": int(rng.integers(1, 9)),
            "beam_width_cells": int(2 * rng.integers(0, 3) + 1),
            "hits_to_tag": int(rng.integers(1, 3)),
            "freeze_steps": int(rng.integers(0, 30)),
            "episode_steps": int(rng.integers(100, 400)),
            "shuffle_starts": bool(rng.integers(2)),
        }
        share = float(rng.random())
        window_steps = int(rng.integers(20, 80))
        quota = Quota(share=share, window_steps=window_steps, by_stock=number % 4 == 0)
        game = commons(*[quota] * (number % 2), **rules)
        if number > 7:
            game = walled(**rules)
        agents = None if number % 5 == 4 else tuple(map(str, rng.choice(policies, game.agents)))
        seed = int(rng.integers(2**63))
        yield f"drawn {number}", Case(game=game, policies=agents, seed=seed, worlds=20)


@pytest.mark.integration
@needs_node
@pytest.mark.filterwarnings("ignore:Quota.window_steps is")
def test_200_games_of_rules_drawn_by_chance_are_equal_in_every_turn(tmp_path):
    path = tmp_path / "drawn.json"
    path.write_text(json.dumps(held(dict(random_cases(np.random.default_rng(77))), every=1)))
    are_equal, said = in_node(path)
    assert are_equal, said
    assert said.startswith("200 games, ")


@pytest.mark.parametrize(
    ("game", "name"),
    [
        (commons(growth="before_bites"), "Rules.growth is 'before_bites'"),
        (commons(regrow_by="share"), "Rules.regrow_by is 'share'"),
        (commons(clashes="in_turn"), "Rules.clashes is 'in_turn'"),
        (presets.game("commons", variant="as_run"), "Rules."),
        (presets.game("ssd/cleanup-v1"), "Rules."),
        (commons(Quota(fine=1.0)), "Quota.fine is 1.0"),
        (commons(Tax(rate=0.5, redistribution="equal")), "Game.institutions is 'Tax'"),
        (commons(Quota(), Quota()), "Game.institutions is 'Quota, Quota'"),
        (commons(Quota(), GraduatedSanctions(on="tags")), "Game.institutions is 'Quota, GraduatedSanctions'"),
        (replace(commons(), observation=Observation(area="full")), "Observation.area is 'full'"),
        (replace(commons(), map=maps.parse("A.P\n>.A")), "Map.spawns is"),
    ],
)
def test_games_that_the_page_cannot_play_are_refused_by_name(game, name):
    with pytest.raises(ValueError, match=f"^{name}.*played in a browser"):
        playable(game)
