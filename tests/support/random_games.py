"""Random games, and what holds in each of their worlds."""

import numpy as np
from boards import assert_same, played, random_actions
from hypothesis import strategies as st

from cprl import Game, Map, Rules
from cprl.commons.headings import COL_STEP, ROW_STEP
from cprl.commons.near import sites_around


@st.composite
def games(draw, **fixed):
    """Small boards with walls, crowded enough for clashes and hits, under rules as published or as run."""
    height, width = draw(st.integers(2, 5)), draw(st.integers(3, 7))
    cells = draw(st.permutations([(r, c) for r in range(height) for c in range(width)]))
    agents = draw(st.integers(1, min(5, len(cells) - 2)))
    walls = draw(st.integers(0, min(3, len(cells) - agents - 1)))
    starts, free = cells[:agents], cells[agents + walls :]
    sites = free[: draw(st.integers(1, len(free)))]
    headings = draw(st.lists(st.integers(0, 3), min_size=agents, max_size=agents))
    board = Map(
        height=height,
        width=width,
        sites=tuple(sites),
        starts=tuple((row, col, heading) for (row, col), heading in zip(starts, headings, strict=True)),
        walls=tuple(cells[agents : agents + walls]),
    )
    rules = {
        "regrow_prob": draw(st.sampled_from([(0.0, 0.3, 0.9), (0.0,), (0.1, 0.5)])),
        "regrow_norm": draw(st.sampled_from(["euclidean", "manhattan", "chebyshev"])),
        "beam_length_cells": draw(st.integers(1, 4)),
        "hits_to_tag": draw(st.integers(1, 2)),
        "freeze_steps": draw(st.integers(0, 6)),
        "window_rows": draw(st.integers(1, 4)),
        "window_columns": draw(st.sampled_from([1, 3, 5])),
        "episode_steps": draw(st.integers(1, 60)),
        **fixed,
    }
    return Game(map=board, rules=Rules(**rules))


def check_places(game, seed):
    """No two agents in play share a cell, and no agent stands in a wall."""
    for worlds, *_ in played(game, random_actions(40, 3, game, seed=seed), seed=seed):
        for b in range(3):
            in_play = worlds.in_play[b]
            places = list(zip(worlds.row[b, in_play].tolist(), worlds.col[b, in_play].tolist(), strict=True))
            assert len(set(places)) == len(places)
            assert not set(places) & set(game.map.walls)
            assert all(0 <= r < game.map.height and 0 <= c < game.map.width for r, c in places)


def check_apples(game, seed):
    """stock + harvest = first stock + regrown, and the apples near each site are counted."""
    moments = played(game, random_actions(40, 3, game, seed=seed), seed=seed)
    first_stock = game.tables.first_stock
    near = sites_around(game.map, game.rules)
    harvest, regrown = np.zeros((2, 3), np.int64)
    for worlds, output, *_ in moments:
        harvest += output.harvest.sum(1).astype(np.int64)
        regrown += output.regrown[:, 0]
        assert np.array_equal(output.stock[:, 0] + harvest, first_stock + regrown)
        assert np.array_equal(worlds.stock.sum(1), output.stock[:, 0])
        assert np.array_equal(worlds.harvested.sum(1), harvest)
        counted = [[stock[others].sum() for others in near] for stock in worlds.stock]
        assert np.array_equal(worlds.near, counted)


def check_worlds_are_independent(game, seed):
    """Each world plays the same game alone, in a batch, and on two threads."""
    actions = random_actions(60, 9, game, seed=3)
    batches = [played(game, actions, seed=seed, threads=threads) for threads in (1, 2)]
    for b in (0, 4, 8):
        alone = played(game, actions[:, b : b + 1].copy(), seed=seed, first_world=b)
        for batch in batches:
            for one, other in zip(alone, batch, strict=True):
                assert_same(one, other, rows=0, other_rows=b)


def check_no_beam_passes_a_wall(game, seed):
    """There is no wall in the beam's column between a shooter and the agent it hits.

    Where nobody is out of play, who is tagged stands elsewhere at the end of the turn, and the shot has no
    place that can be told.
    """
    if game.rules.freeze_steps == 0:
        return 0
    walls = set(game.map.walls)
    hits = 0
    for worlds, output, *_ in played(game, random_actions(200, 3, game, seed=seed), seed=seed):
        for b, target, shooter in np.argwhere(output.hit_by):
            hits += 1
            heading = worlds.heading[b, shooter]
            here, there = ((worlds.row[b, i], worlds.col[b, i]) for i in (shooter, target))
            ahead = (there[0] - here[0]) * ROW_STEP[heading] + (there[1] - here[1]) * COL_STEP[heading]
            for away in range(ahead):
                cell = there[0] - away * ROW_STEP[heading], there[1] - away * COL_STEP[heading]
                assert cell not in walls
    return hits
