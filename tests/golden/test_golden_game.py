"""The game plays as it did: checksums of all that 150 turns of 16 worlds give, board by board."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from golden import assert_held, checksum

from cprl import CommonsEnv, Game, Observation, Rules, keys, maps, presets
from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    GraduatedSanctions,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Sanctioner,
    Tax,
    Vote,
)

WORLDS, TURNS, EPISODE_STEPS = 16, 150, 60
GAMES = [
    (board, variant)
    for board in ("single_basic", "single_complex", "two_complex", "commons")
    for variant in ("published", "as_run")
]
FORMS = {
    f"{area}, {encoding}{', apart' * apart}{', scores' * scores}": Observation(
        area=area, encoding=encoding, agents_apart=apart, scoreboard=scores, stock_gauge=scores
    )
    for area in ("window", "full")
    for encoding in ("rgb", "one_hot")
    for apart in (False, True)
    for scores in (False, True)
    if area == "window" or not scores
}
QUOTA = Quota(share=0.25, window_steps=20, fine=1.5)
INSTITUTIONS = {
    "boundaries that stop": (Boundaries.strips(height=12, width=24, agents=4),),
    "boundaries that fine": (
        Boundaries.strips(height=12, width=24, agents=4, bite_fine=0.5, step_fine=0.25),
    ),
    "a quota that stops": (Quota(share=0.25, window_steps=20),),
    "a quota that fines": (QUOTA,),
    "a quota by the stock": (Quota(share=0.25, window_steps=20, by_stock=True),),
    "a closed season": (ClosedSeason(period_steps=20, closed_steps=5),),
    "a closed season that fines": (ClosedSeason(period_steps=20, closed_steps=5, fine=0.75),),
    "closed patches": (ClosedPatches(below=2),),
    "closed patches that fine": (ClosedPatches(below=3, fine=0.5),),
    "a tax": (Tax(rate=0.3),),
    "a tax in brackets": (Tax(brackets=((0, 0.1), (2, 0.5)), redistribution="none", period_steps=10),),
    "levies": (Levies(groups=((0, 1), (2, 3)), local_rate=0.3, joint_rate=0.2),),
    "monitoring": (QUOTA, Monitoring(prob=0.5)),
    "a monitor who pays": (QUOTA, Monitoring(prob=0.7, cost=0.2, monitor=1)),
    "graduated sanctions": (
        Quota(share=0.25, window_steps=20, fine=0.0),
        GraduatedSanctions(freeze_steps=(5, 25, 50), fines=(0, 1, 2), recovery_steps=20),
    ),
    "mediation": (Quota(share=0.25, window_steps=20, fine=0.0), Mediation(turns=20, refund=1.0)),
    "a vote on a tax": (Vote(on=Tax(), choices=(0.0, 0.25, 0.5, 0.75)),),
    "a vote on a quota": (Vote(on=Quota(window_steps=10), choices=(0.2, 1.0), override_prob=0.3),),
    "a sanctioner": (Sanctioner(),),
    "an elected monitor": (QUOTA, Monitoring(prob=0.7, cost=0.2, monitor="elected")),
}
OTHER_RULES = {
    "starts are shuffled": {"shuffle_starts": True},
    "growth by the chessboard": {"regrow_norm": "chebyshev", "regrow_radius_cells": 1.0},
    "growth by streets": {"regrow_norm": "manhattan", "regrow_radius_cells": 3.0},
    "wide and uneven beams": {"beam_width_cells": 5, "beam_length_cells": (3, 4, 5, 6), "hits_to_tag": 2},
}
WALLED = maps.parse(
    """
    >AA.A.<..
    .A#A..#AA
    ..A.^.AA.
    A.#...#.v
    """
)


def played(game):
    """The checksum over all turns of each entry that the environment gave."""
    env = CommonsEnv(game, worlds=WORLDS, seed=7, state=True)
    rng = np.random.default_rng(20261125)
    entries = {}
    now = env.reset()

    def take(step):
        for key in step.keys(True, True):
            name = key if isinstance(key, str) else "/".join(key)
            if key != keys.APPLE_AHEAD:  # which is younger than the checksums, and changed none of the others
                entries.setdefault(name, []).append(step[key].numpy().copy())

    take(now)
    for _ in range(TURNS):
        choices = {"action": len(game.rules.actions), "decision": game.decisions}
        for name, count in choices.items():
            if count:
                chosen = rng.integers(count, size=(WORLDS, game.agents))
                now["agents", name] = torch.from_numpy(chosen)
        step, now = env.step_and_maybe_reset(now)
        take(step["next"])
    return {name: checksum(*arrays) for name, arrays in sorted(entries.items())}


def shortened(game, **changes):
    return replace(game, rules=replace(game.rules, episode_steps=EPISODE_STEPS), **changes)


@pytest.mark.parametrize(("board", "variant"), GAMES)
def test_a_board_plays_as_it_did(board, variant):
    assert_held("game", {f"{board}, {variant}": played(shortened(presets.game(board, variant=variant)))})


@pytest.mark.integration
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("board", "variant"), GAMES)
def test_a_form_of_observation_shows_what_it_did(board, variant, form):
    game = shortened(presets.game(board, variant=variant), observation=FORMS[form])
    assert_held("observations", {f"{board}, {variant}, {form}": played(game)})


@pytest.mark.parametrize("name", INSTITUTIONS)
def test_an_institution_rules_as_it_did(name):
    observation = Observation(agents_apart="mediation" in name)
    game = shortened(presets.game("commons"), institutions=INSTITUTIONS[name], observation=observation)
    assert_held("institutions", {name: played(game)})


@pytest.mark.integration
@pytest.mark.parametrize("name", INSTITUTIONS)
def test_an_institution_rules_as_it_did_in_the_game_as_run(name):
    observation = Observation(agents_apart=True, encoding="one_hot")
    game = presets.game("commons", variant="as_run")
    game = shortened(game, institutions=INSTITUTIONS[name], observation=observation)
    assert_held("institutions", {f"{name}, as run": played(game)})


@pytest.mark.parametrize("name", OTHER_RULES)
def test_rules_that_no_preset_has_play_as_they_did(name):
    rules = Rules(
        regrow_prob=(0, 0.05, 0.2), freeze_steps=8, episode_steps=EPISODE_STEPS, **OTHER_RULES[name]
    )
    assert_held("rules", {name: played(Game(map=WALLED, rules=rules))})
