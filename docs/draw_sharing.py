"""The herders' game, drawn for docs/theory/herders.png by `python docs/draw_figures.py theory`."""

import sys
from pathlib import Path
from typing import Final

import numpy as np

from cprl.terminal.style import MARK_COLOUR, MEAN_COLOUR, RAW_COLOUR, drawing

sys.path.insert(0, str(Path(__file__).parents[1] / "recipes" / "study" / "theory"))

from sharing_games import herders

PATH: Final = Path(__file__).parent / "theory" / "herders.png"
HERDS: Final = (2, 5, 100)
MANY: Final = np.unique(np.geomspace(1, 100, 60).round().astype(int))


def draw_herders() -> None:
    """Draw what all gain against the animals that graze; animals and the price of anarchy by the herders."""
    with drawing(PATH) as sheet:
        left, middle, right = sheet.panels(3, columns=3, row_height_em=23, width_ratios=(1.25, 1, 1))
        one = herders(1)
        totals = np.linspace(0, 1.05 * one.open_access_total, 200)
        left.plot(totals, [one.surplus(total) for total in totals], color=MEAN_COLOUR, linewidth=2)
        left.axhline(0, color=RAW_COLOUR, linewidth=1)
        for name, at in (
            ("optimum", one.optimum_total),
            *((f"n = {herd}", herders(herd).nash_total) for herd in HERDS),
        ):
            is_best = name == "optimum"
            colour = "black" if is_best else MARK_COLOUR
            left.plot(at, one.surplus(at), "o", color=colour, markersize=6)
            above = {"xytext": (0, 6), "ha": "center"} if is_best else {"xytext": (6, 4), "ha": "left"}
            left.annotate(name, (at, one.surplus(at)), textcoords="offset points", **above)
        left.set_ylim(-1.2, 1.15 * one.surplus(one.optimum_total))
        left.set_xlim(0, 1.3 * one.open_access_total)
        left.set_title("what all gain; red: in equilibrium")
        left.set_xlabel("animals A")
        games = [herders(int(herd)) for herd in MANY]
        middle.plot(
            MANY, [game.nash_total for game in games], color=MARK_COLOUR, linewidth=2, label="equilibrium A*"
        )
        middle.plot(
            MANY, [game.optimum_total for game in games], color="black", linewidth=2, label="optimum A**"
        )
        access = one.open_access_total
        middle.axhline(access, color=RAW_COLOUR, linestyle=":", linewidth=1.4, label="open access")
        middle.set_ylim(0, 1.1 * access)
        middle.set_title("animals, by the number of herders")
        right.plot(MANY, [game.price_of_anarchy for game in games], color=MARK_COLOUR, linewidth=2)
        right.set_ylim(0, None)
        right.set_title("gain at the optimum over that in equilibrium")
        for panel in (middle, right):
            panel.set_xscale("log")
            panel.set_xticks([1, 2, 5, 10, 100], ["1", "2", "5", "10", "100"])
            panel.minorticks_off()
            panel.set_xlabel("herders n")
        sheet.title = "The herders' game"
        sheet.caption = "An animal is worth 10 - A^2 and costs 1."
