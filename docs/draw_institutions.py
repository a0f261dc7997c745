"""Draws each institution at work: docs/institutions/<name>.png.

python docs/draw_institutions.py
"""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from institution_pictures import (
    CELL,
    EDGE,
    SEED,
    TEXT_PT,
    commons,
    drawn,
    hue,
    legend,
    new_figure,
    pay_bars,
    play,
    point,
    shade,
    show_board,
    stock_lines,
    titled,
)
from matplotlib.figure import Figure

from cprl import Game, Rules, maps
from cprl.commons.near import patches, sites_around
from cprl.commons.yields import sustainable_yield
from cprl.institutions import (
    COUNTS,
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
from cprl.terminal.style import MARK, MEAN, RAW, on_white

FOLDER: Final = Path(__file__).parent / "institutions"
DPI: Final = 110
NO_RULE: Final = Tax(rate=0.0)


def boundaries() -> Figure:
    """A bite in the region of others that does not happen."""
    rows = "..AA.....AA..", ".AAA.....AAA.", ">.AA.>...AA..", "..AA....AAA.<", "..A......A..."
    rule = Boundaries(regions=("0000001111111",) * 5, owners=("0", "0", "1"))
    course = play(
        drawn("\n".join(rows), rule), ["forward forward forward"] * 2 + ["stay forward stay"] * 2, 4
    )
    figure, (panel,) = new_figure(3.1)
    show_board(panel, course.image, "The left region is of agents 0 and 1, the right one of agent 2")
    for owner, first, cols in ((0, 0, 6), (2, 6, 7)):
        shade(panel, 0, first, 5, cols, facecolor=(*hue(owner), 0.25), edgecolor=hue(owner), linewidth=2)
    at = int(course.row[-1, 1]), int(course.col[-1, 1])
    point(panel, "agent 1 cannot\nharvest here", at, (0.45, 7.2))
    return figure


def quota() -> Figure:
    """The harvest of each agent in a window, which ends at the quota."""
    game = commons(Quota(share=0.5, window_steps=50))
    course, free = play(game, "greedy", 200), play(commons(NO_RULE), "greedy", 200)
    figure, (panel, below) = new_figure(4.6, 2, sharex=True)
    most = 0.5 * sustainable_yield(game.map, game.rules) * 50 / 4
    for first in range(0, 200, 50):
        for i in range(4):
            taken = np.concatenate([[0.0], course.harvest[first : first + 50, i].cumsum()])
            label = f"agent {i}" if first == 0 else None
            panel.step(
                np.arange(first, first + 51), taken, where="post", label=label, linewidth=2, **on_white(i)
            )
    panel.axhline(most, color=MARK, linestyle="--", linewidth=1.6, label=f"quota, {most:.1f}")
    titled(panel, "Harvest of each agent in windows of 50 turns", y="apples")
    panel.set_ylim(0, 1.45 * most)
    legend(panel, ncols=5, loc="upper center")
    stock_lines(below, course, free, "Quota(share=0.5)")
    legend(below)
    return figure


def closed_season() -> Figure:
    """The stock, which recovers while the season is closed."""
    season = ClosedSeason(period_steps=50, closed_steps=25)
    course, free = (play(commons(own), "greedy", 300) for own in (season, NO_RULE))
    figure, (panel,) = new_figure(2.9)
    stock_lines(panel, course, free, "ClosedSeason(period_steps=50, closed_steps=25)")
    for first in range(25, 300, 50):
        panel.axvspan(first, first + 25, color="#dddddd", label="closed" if first == 25 else None)
    panel.set_ylim(0, 120)
    legend(panel, ncols=3, loc="upper center")
    return figure


def closed_patches() -> Figure:
    """Which patches are closed, and what becomes of the stock."""
    board = maps.crosses(
        height=7,
        width=24,
        centres=((2, 3), (4, 9), (2, 15), (4, 20)),
        starts=((5, 3, 1), (1, 9, 3), (5, 15, 1), (1, 20, 3)),
    )
    rule, free = (
        Game(map=board, rules=Rules(), institutions=(own,)) for own in (ClosedPatches(below=3), NO_RULE)
    )
    course, other = play(rule, "greedy", 200), play(free, "greedy", 200)
    figure, (panel, below) = new_figure(4.8, 2, height_ratios=(1.2, 1))
    patch = patches(sites_around(board, rule.rules))
    held = np.bincount(patch, weights=course.apples[-1])
    show_board(panel, course.image, "Turn 200: hatched patches hold fewer than 3 apples and are closed")
    taken = set(zip(course.row[-1].tolist(), course.col[-1].tolist(), strict=True))
    for (row, col), own in zip(board.sites, patch, strict=True):
        if held[own] < 3 and (row, col) not in taken:
            shade(panel, row, col, facecolor="none", edgecolor="white", hatch="////", linewidth=0.4)
    stock_lines(below, course, other, "ClosedPatches(below=3)")
    below.set_ylim(0, 28)
    legend(below, ncols=2, loc="upper right")
    return figure


def vote() -> Figure:
    """Decisions, their median, and what an authority puts in force in its place."""
    choices, episodes = (0.0, 0.25, 0.5, 0.75, 1.0), 14
    rule = Vote(on=Tax(), choices=choices, override_prob=0.2)
    decided = np.random.default_rng(SEED).integers(0, len(choices), (episodes, 4))
    course = play(commons(rule), "greedy", 1, episodes=episodes, decisions=lambda episode: decided[episode])
    figure, (panel,) = new_figure(3.0)
    for i in range(4):
        x, y = np.arange(episodes) - 0.24 + 0.16 * i, np.array(choices)[decided[:, i]]
        panel.plot(x, y, "o", markersize=7, color=hue(i), markeredgecolor=EDGE, label=f"agent {i}")
    median = np.array(choices)[np.sort(decided, 1)[:, 1]]
    force = course.in_force[:, 0]
    panel.hlines(force, np.arange(episodes) - 0.42, np.arange(episodes) + 0.42, color=EDGE, label="in force")
    over = np.flatnonzero(~np.isclose(force, median))
    panel.plot(
        over, force[over], "x", color=MARK, markersize=11, markeredgewidth=2.5, label="by the authority"
    )
    panel.set_xticks(range(episodes))
    panel.set_yticks(choices)
    panel.set_ylim(-0.08, 1.4)
    titled(panel, "Four agents vote on the rate of a tax; override_prob=0.2", "episode", "rate")
    legend(panel, ncols=6, loc="upper center", columnspacing=1.0, handletextpad=0.3)
    return figure


def monitoring() -> Figure:
    """Turns with a violation, and which were detected."""
    rule = Quota(share=0.25, window_steps=50, fine=2.0), Monitoring(prob=0.5)
    course = play(commons(*rule), "greedy", 100)
    broke, found = course.counted("violations"), course.counted("detections")
    figure, (panel,) = new_figure(2.6)
    for i in range(4):
        for marks, how in ((broke - found, {"markerfacecolor": "white"}), (found, {"color": hue(i)})):
            at = np.flatnonzero(marks[:, i]) + 1
            panel.plot(at, np.full(len(at), i), "o", markersize=8, markeredgecolor=EDGE, **how)
    panel.set_yticks(range(4), [f"agent {i}, {found[:, i].sum()} of {broke[:, i].sum()}" for i in range(4)])
    panel.set_ylim(3.6, -0.6)
    panel.set_xlim(0, 101)
    titled(panel, "Bites above a quota; filled and counted first: detected (prob=0.5)", "turn")
    return figure


def graduated_sanctions() -> Figure:
    """The level of an agent, its time-outs and its fines."""
    rule = Quota(share=0.25, window_steps=50, fine=0.0), GraduatedSanctions()
    turns = np.arange(1, 401)
    course = play(commons(*rule), "greedy", len(turns))
    agent = int(course.counts[-1, :, COUNTS.index("sanctions")].argmax())
    figure, (panel,) = new_figure(3.0)
    panel.step(turns, course.level[:, agent], where="post", color=MEAN, linewidth=2.2, label="level")
    out = ~course.in_play[:, agent]
    panel.fill_between(turns, 0, 5, where=out, step="post", color="#dddddd", label="out of play")
    at = np.flatnonzero(course.counted("sanctions")[:, agent])
    panel.plot(at + 1, course.level[at, agent], "^", color=MARK, markersize=9, label="offence, and its fine")
    for turn in at:
        text = f"{course.fines[turn, agent]:g}"
        panel.text(turn + 1, course.level[turn, agent] + 0.3, text, ha="center", fontsize=TEXT_PT, color=MARK)
    panel.set_ylim(-0.1, 5)
    panel.set_xlim(0, len(turns))
    titled(
        panel, f"Agent {agent}: each offence raises the level, 50 turns without one lower it", "turn", "level"
    )
    legend(panel, ncols=3, loc="upper center")
    return figure


def sanctioner() -> Figure:
    """An election, after which all want to fire."""
    rows = "....A....", ".>..A..<.", "...AAA...", ".>..A..<.", "....A...."
    decided = 2, 2, 0, 1
    rule = Sanctioner()
    course = play(drawn("\n".join(rows), rule), ["beam " * 4], 1, decisions=lambda episode: decided)
    figure, (panel, board) = new_figure(2.6, 1, 2, width_ratios=(1, 1.5))
    votes = np.bincount(decided, minlength=4)
    panel.bar(range(4), votes, color=[hue(i) for i in range(4)], edgecolor=EDGE)
    panel.set_xticks(range(4), [f"agent {i}" for i in range(4)])
    panel.set_yticks(range(max(votes) + 1))
    titled(panel, f"Decisions: {', '.join(map(str, decided))}", y="votes")
    show_board(board, course.image, "All choose the beam, agent 2 fires")
    return figure


def mediation() -> Figure:
    """An unjust tag and a just one."""
    rows = "A......", ".>..A<.", ".....A."
    rule = Quota(share=0.0, fine=0.0), Mediation(turns=10, refund=1.0, observed=False)
    figure, panels = new_figure(2.2, 1, 2)
    for panel, first in zip(panels, ("stay stay", "stay forward"), strict=True):
        course = play(drawn("\n".join(rows), *rule), [first, "beam stay"], 2)
        paid, given = course.fines[-1, 0], course.transfers[-1, 1]
        title = "Agent 1 broke no rule: unjust" if paid else "Agent 1 has just broken a quota: just"
        show_board(panel, course.image, title)
        where = int(course.row[-1, 1]), int(course.col[-1, 1])
        shade(panel, *where, facecolor="none", edgecolor="white", linewidth=2)
        note = f"agent 0 pays {paid:g}, agent 1 is given {given:g}" if paid else "nobody pays"
        panel.text(3.5 * CELL, 3.45 * CELL, note, ha="center", fontsize=TEXT_PT)
    return figure


def levies() -> Figure:
    """What two groups keep and share."""
    rule = Levies(groups=((0, 1), (2, 3)), local_rate=0.4, joint_rate=0.1)
    course = play(commons(rule), "random", 300)
    figure, (panel,) = new_figure(3.0)
    pay_bars(panel, course, "Groups (0, 1) and (2, 3), local_rate=0.4, joint_rate=0.1")
    panel.axvline(1.5, ymax=0.85, color=EDGE, linestyle=":", linewidth=1.2)
    return figure


def tax() -> Figure:
    """A tax with brackets, and what becomes of it."""
    brackets = (0.0, 0.0), (1.0, 0.25), (3.0, 0.5)
    course = play(commons(Tax(brackets=brackets, period_steps=100)), "random", 300)
    figure, (panel, right) = new_figure(3.0, 1, 2, width_ratios=(1, 1.8))
    panel.plot([0, 1, 3, 6], [0, 0, 0.5, 2], color=MEAN, linewidth=2.2)
    for start, _ in brackets[1:]:
        panel.axvline(start, color=RAW, linestyle="--", linewidth=1.2)
    for middle, rate in ((0.4, 0), (2, 25), (4.5, 50)):
        panel.text(middle, 2.05, f"{rate} %", ha="center", fontsize=TEXT_PT)
    panel.set_ylim(-0.1, 2.3)
    titled(panel, "Tax on a period's harvest", "apples harvested", "apples owed")
    pay_bars(right, course, "Three periods of 100 turns, paid out equally")
    return figure


DRAWN: Final[tuple[Callable[[], Figure], ...]] = (
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


def main() -> None:
    """Writes a PNG for each institution."""
    FOLDER.mkdir(exist_ok=True)
    for draw in DRAWN:
        path = FOLDER / f"{draw.__name__}.png"
        draw().savefig(path, dpi=DPI, pil_kwargs={"optimize": True})
        print(path)


if __name__ == "__main__":
    main()
