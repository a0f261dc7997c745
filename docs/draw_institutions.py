"""Each institution at work, for docs/institutions/NAME.png: `python docs/draw_figures.py institutions`."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from institution_pictures import (
    CELL,
    EDGE,
    SEED,
    commons,
    drawn,
    hue,
    label,
    pay_bars,
    play,
    point,
    shade,
    show_board,
    stock_lines,
)
from published_figures import on_white

from cprl import Game, Rules, maps
from cprl.commons.near import patches, sites_around
from cprl.commons.yields import sustainable_yield
from cprl.institutions import (
    COUNT_NAMES,
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
from cprl.terminal.style import MARK_COLOUR, MEAN_COLOUR, RAW_COLOUR, Sheet, drawing

FOLDER: Final = Path(__file__).parent / "institutions"
NO_RULE: Final = Tax(rate=0.0)


def boundaries(sheet: Sheet) -> None:
    """Draw a bite in the region of others that does not happen."""
    rows = ("..AA.....AA..", ".AAA.....AAA.", ">.AA.>...AA..", "..AA....AAA.<", "..A......A...")
    rule = Boundaries(regions=("0000001111111",) * 5, owners=("0", "0", "1"))
    actions = ["forward forward forward"] * 2 + ["stay forward stay"] * 2
    course = play(drawn("\n".join(rows), rule), actions, 4)
    (panel,) = sheet.panels(1, row_height_em=22)
    show_board(panel, course.image, "The left region is of agents 0 and 1, the right one of agent 2")
    for owner, first, cols in ((0, 0, 6), (2, 6, 7)):
        shade(panel, 0, first, 5, cols, facecolor=(*hue(owner), 0.25), edgecolor=hue(owner), linewidth=2)
    place = (int(course.row[-1, 1]), int(course.col[-1, 1]))
    point(panel, "agent 1 cannot\nharvest here", place, (0.45, 7.2))


def quota(sheet: Sheet) -> None:
    """Draw the harvest of each agent in a window, which ends at the quota."""
    game = commons(Quota(share=0.5, window_steps=50))
    course = play(game, "greedy", 200)
    free = play(commons(NO_RULE), "greedy", 200)
    panel, below = sheet.panels(2, row_height_em=16, sharex=True)
    most = 0.5 * sustainable_yield(game.map, game.rules) * 50 / 4
    for first in range(0, 200, 50):
        turns = np.arange(first, first + 51)
        for i in range(4):
            taken = np.concatenate([[0.0], course.harvest[first : first + 50, i].cumsum()])
            panel.step(turns, taken, where="post", label=f"agent {i}", linewidth=2, **on_white(i))
    panel.axhline(most, color=MARK_COLOUR, linestyle="--", linewidth=1.6, label=f"quota, {most:.1f}")
    label(panel, "Harvest of each agent in windows of 50 turns", y="apples")
    panel.set_ylim(0, 1.1 * most)
    stock_lines(below, course, free, "Quota(share=0.5)")


def closed_season(sheet: Sheet) -> None:
    """Draw the stock, which recovers while the season is closed."""
    season = ClosedSeason(period_steps=50, closed_steps=25)
    course = play(commons(season), "greedy", 300)
    free = play(commons(NO_RULE), "greedy", 300)
    (panel,) = sheet.panels(1, row_height_em=19)
    stock_lines(panel, course, free, "ClosedSeason(period_steps=50, closed_steps=25)")
    for first in range(25, 300, 50):
        panel.axvspan(first, first + 25, color="#dddddd", label="closed")


def closed_patches(sheet: Sheet) -> None:
    """Draw which patches are closed, and what becomes of the stock."""
    board = maps.crosses(
        height=7,
        width=24,
        centres=((2, 3), (4, 9), (2, 15), (4, 20)),
        starts=((5, 3, 1), (1, 9, 3), (5, 15, 1), (1, 20, 3)),
    )
    game = Game(map=board, rules=Rules(), institutions=(ClosedPatches(below=3),))
    course = play(game, "greedy", 200)
    other = play(replace(game, institutions=(NO_RULE,)), "greedy", 200)
    panel, below = sheet.panels(2, row_height_em=[20, 17])
    patch_of_site = patches(sites_around(board, game.rules))
    held = np.bincount(patch_of_site, weights=course.apples[-1])
    show_board(panel, course.image, "Turn 200: hatched patches hold fewer than 3 apples and are closed")
    taken = set(zip(course.row[-1].tolist(), course.col[-1].tolist(), strict=True))
    for (row, col), patch in zip(board.sites, patch_of_site, strict=True):
        if held[patch] < 3 and (row, col) not in taken:
            shade(panel, row, col, facecolor="none", edgecolor="white", hatch="////", linewidth=0.4)
    stock_lines(below, course, other, "ClosedPatches(below=3)")


def vote(sheet: Sheet) -> None:
    """Draw decisions, their median, and what an authority puts in force in its place."""
    choices = (0.0, 0.25, 0.5, 0.75, 1.0)
    episodes = 14
    rule = Vote(on=Tax(), choices=choices, override_prob=0.2)
    decided = np.random.default_rng(SEED).integers(0, len(choices), (episodes, 4))
    course = play(commons(rule), "greedy", 1, episodes=episodes, decisions=lambda episode: decided[episode])
    (panel,) = sheet.panels(1, row_height_em=20)
    places = np.arange(episodes)
    for i in range(4):
        rates = np.array(choices)[decided[:, i]]
        look = {"color": hue(i), "markeredgecolor": EDGE, "label": f"agent {i}"}
        panel.plot(places - 0.24 + 0.16 * i, rates, "o", markersize=7, **look)
    median = np.array(choices)[np.sort(decided, 1)[:, 1]]
    force = course.in_force[:, 0]
    panel.hlines(force, places - 0.42, places + 0.42, color=EDGE, label="in force")
    over = np.flatnonzero(~np.isclose(force, median))
    cross = {"color": MARK_COLOUR, "markersize": 11, "markeredgewidth": 2.5, "label": "by the authority"}
    panel.plot(over, force[over], "x", **cross)
    panel.set_xticks(range(episodes))
    panel.set_yticks(choices)
    label(panel, "Four agents vote on the rate of a tax; override_prob=0.2", "episode", "rate")


def monitoring(sheet: Sheet) -> None:
    """Draw the turns with a violation, and which were detected."""
    rules = (Quota(share=0.25, window_steps=50, fine=2.0), Monitoring(prob=0.5))
    course = play(commons(*rules), "greedy", 100)
    broke = course.counted("violations")
    detected = course.counted("detections")
    (panel,) = sheet.panels(1, row_height_em=17)
    for i in range(4):
        for marks, colour in ((broke - detected, "white"), (detected, hue(i))):
            turns = np.flatnonzero(marks[:, i]) + 1
            look = {"markersize": 8, "markeredgecolor": EDGE, "markerfacecolor": colour}
            panel.plot(turns, np.full(len(turns), i), "o", **look)
    shares = [f"agent {i}, {detected[:, i].sum()} of {broke[:, i].sum()}" for i in range(4)]
    panel.set_yticks(range(4), shares)
    panel.set_ylim(3.6, -0.6)
    panel.set_xlim(0, 101)
    label(panel, "Bites above a quota; filled and counted first: detected (prob=0.5)", "turn")


def graduated_sanctions(sheet: Sheet) -> None:
    """Draw the level of an agent, its time-outs and its fines."""
    rules = (Quota(share=0.25, window_steps=50, fine=0.0), GraduatedSanctions())
    turns = np.arange(1, 401)
    course = play(commons(*rules), "greedy", len(turns))
    agent = int(course.counts[-1, :, COUNT_NAMES.index("sanctions")].argmax())
    (panel,) = sheet.panels(1, row_height_em=20)
    level = course.level[:, agent]
    panel.step(turns, level, where="post", color=MEAN_COLOUR, linewidth=2.2, label="level")
    is_out = ~course.in_play[:, agent]
    panel.fill_between(turns, 0, 4, where=is_out, step="post", color="#dddddd", label="out of play")
    offences = np.flatnonzero(course.counted("sanctions")[:, agent])
    mark = {"color": MARK_COLOUR, "markersize": 9, "label": "offence, and its fine"}
    panel.plot(offences + 1, level[offences], "^", **mark)
    for turn in offences:
        fine = f"{course.fines[turn, agent]:g}"
        panel.text(turn + 1, level[turn] + 0.3, fine, ha="center", color=MARK_COLOUR)
    panel.set_ylim(-0.1, 4)
    panel.set_xlim(0, len(turns))
    title = f"Agent {agent}: each offence raises the level, 50 turns without one lower it"
    label(panel, title, "turn", "level")


def sanctioner(sheet: Sheet) -> None:
    """Draw an election, after which all want to fire."""
    rows = ("....A....", ".>..A..<.", "...AAA...", ".>..A..<.", "....A....")
    decided = (2, 2, 0, 1)
    game = drawn("\n".join(rows), Sanctioner())
    course = play(game, ["beam " * 4], 1, decisions=lambda episode: decided)
    panel, board = sheet.panels(2, columns=2, row_height_em=18, width_ratios=(1, 1.5))
    votes = np.bincount(decided, minlength=4)
    panel.bar(range(4), votes, color=[hue(i) for i in range(4)], edgecolor=EDGE)
    panel.set_xticks(range(4), [f"agent {i}" for i in range(4)])
    panel.set_yticks(range(max(votes) + 1))
    label(panel, f"Decisions: {', '.join(map(str, decided))}", y="votes")
    show_board(board, course.image, "All choose the beam, agent 2 fires")


def mediation(sheet: Sheet) -> None:
    """Draw an unjust tag and a just one."""
    rows = ("A......", ".>..A<.", ".....A.")
    rules = (Quota(share=0.0, fine=0.0), Mediation(turns=10, refund=1.0, observed=False))
    panels = sheet.panels(2, columns=2, row_height_em=17)
    for panel, first in zip(panels, ("stay stay", "stay forward"), strict=True):
        course = play(drawn("\n".join(rows), *rules), [first, "beam stay"], 2)
        paid = course.fines[-1, 0]
        given = course.transfers[-1, 1]
        title = "Agent 1 has just broken a quota: just"
        note = "nobody pays"
        if paid:
            title = "Agent 1 broke no rule: unjust"
            note = f"agent 0 pays {paid:g}, agent 1 is given {given:g}"
        show_board(panel, course.image, title)
        row = int(course.row[-1, 1])
        col = int(course.col[-1, 1])
        shade(panel, row, col, facecolor="none", edgecolor="white", linewidth=2)
        panel.text(3.5 * CELL, 3.45 * CELL, note, ha="center")


def levies(sheet: Sheet) -> None:
    """Draw what two groups keep and share."""
    rule = Levies(groups=((0, 1), (2, 3)), local_rate=0.4, joint_rate=0.1)
    course = play(commons(rule), "random", 300)
    (panel,) = sheet.panels(1, row_height_em=19)
    pay_bars(panel, course, "Groups (0, 1) and (2, 3), local_rate=0.4, joint_rate=0.1")
    panel.axvline(1.5, color=EDGE, linestyle=":", linewidth=1.2)


def tax(sheet: Sheet) -> None:
    """Draw a tax with brackets, and what becomes of it."""
    brackets = ((0.0, 0.0), (1.0, 0.25), (3.0, 0.5))
    course = play(commons(Tax(brackets=brackets, period_steps=100)), "random", 300)
    panel, right = sheet.panels(2, columns=2, row_height_em=20, width_ratios=(1, 1.8))
    panel.plot([0, 1, 3, 6], [0, 0, 0.5, 2], color=MEAN_COLOUR, linewidth=2.2)
    for start, _ in brackets[1:]:
        panel.axvline(start, color=RAW_COLOUR, linestyle="--", linewidth=1.2)
    for middle, rate in ((0.4, 0), (2, 25), (4.5, 50)):
        panel.text(middle, 2.05, f"{rate} %", ha="center")
    panel.set_ylim(-0.1, 2.3)
    label(panel, "Tax on a period's harvest", "apples harvested", "apples owed")
    pay_bars(right, course, "Three periods of 100 turns, paid out equally")


DRAWN: Final[tuple[Callable[[Sheet], None], ...]] = (
    boundaries,
    quota,
    closed_season,
    closed_patches,
    vote,
    monitoring,
    graduated_sanctions,
    sanctioner,
    mediation,
    levies,
    tax,
)


def draw_institutions() -> None:
    """Write a PNG for each institution."""
    for draw in DRAWN:
        with drawing(FOLDER / f"{draw.__name__}.png") as sheet:
            draw(sheet)
