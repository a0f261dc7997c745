"""Helpers of the tests of institutions: random games with institutions, and how they are played."""

from dataclasses import replace

import numpy as np
from boards import played, random_actions
from hypothesis import strategies as st
from random_games import games

from cprl import Game, Observation, Rules, institutions as law, maps

EVERYTHING = Game(
    map=maps.parse(
        """
        >AA.A.<
        .A#A...
        ..A.^.A
        """
    ),
    rules=Rules(regrow_prob=(0.05, 0.5), freeze_steps=4, episode_steps=25, window_rows=3, window_columns=5),
    observation=Observation(agents_apart=True),
    institutions=(
        law.Boundaries.drawn("001122-\n.......\n..3..22", owners=("01", "13", "2"), bite_fine=0.5),
        law.Boundaries.drawn(".......\n..012..\n.......", step_fine=0.25, observed=False),
        law.Quota(share=0.5, window_steps=4, fine=1),
        law.Vote(on=law.Quota(window_steps=6, by_stock=True), choices=(0.5, 1, 2)),
        law.ClosedSeason(period_steps=9, closed_steps=2, fine=0.75),
        law.ClosedPatches(below=2, fine=0.1),
        law.Rotation(window_steps=5, fine=0.2),
        law.Vote(on=law.Tax(period_steps=3), choices=(0.0, 0.3), override_prob=0.5, period_episodes=2),
        law.Tax(brackets=((0, 0.1), (2, 0.4)), redistribution="none", period_steps=5),
        law.Levies(groups=((1,), (2, 0))),
        law.Monitoring(prob=0.7, cost=0.2, monitor="elected"),
        law.GraduatedSanctions(freeze_steps=(1, 2, 6), fines=(0, 0.5), recovery_steps=5),
        law.Mediation(turns=2, refund=0.6),
        law.Sanctioner(override_prob=0.3),
    ),
)
"""A game with every kind of institution at once."""

FINES = st.sampled_from([0.0, 0.5, 3.0])


def boundaries(board, fine, step_fine):
    """Boundaries with regions of agents, reserves and open ground."""
    signs = ".-" + "".join(str(agent) for agent in range(board.agents))
    row = st.text(signs, min_size=board.width, max_size=board.width)
    rows = st.lists(row, min_size=board.height, max_size=board.height).map(tuple)
    return st.builds(law.Boundaries, regions=rows, bite_fine=fine, step_fine=step_fine)


def quotas(fine):
    return st.builds(
        law.Quota,
        share=st.sampled_from([0.0, 0.5, 2.0]),
        window_steps=st.integers(1, 9),
        by_stock=st.booleans(),
        fine=fine,
        observed=st.booleans(),
    )


def taxes():
    return st.builds(
        law.Tax,
        rate=st.floats(0, 1, allow_subnormal=False),
        redistribution=st.sampled_from(["equal", "none"]),
        period_steps=st.integers(1, 7),
        brackets=st.sampled_from([(), ((0, 0.2), (1, 0.5)), ((0, 0.0), (2.5, 1.0))]),
    )


def levies(agents):
    def grouped(order, cut):
        groups = [group for group in (order[:cut], order[cut:]) if group]
        return law.Levies(groups=tuple(map(tuple, groups)), local_rate=0.25, joint_rate=0.5)

    return st.builds(grouped, st.permutations(range(agents)), st.integers(0, agents))


def votes(on):
    return st.builds(
        law.Vote,
        on=on,
        choices=st.sampled_from([(0.0, 1.0), (0.1, 0.5, 0.9)]),
        period_episodes=st.integers(1, 2),
        override_prob=st.sampled_from([0.0, 0.5]),
    )


MONITORS = st.builds(
    law.Monitoring,
    prob=st.sampled_from([0.0, 0.5, 1.0]),
    cost=st.sampled_from([0.0, 0.5]),
    monitor=st.sampled_from([None, 0, "elected"]),
)
MEDIATIONS = st.builds(law.Mediation, turns=st.integers(1, 5), refund=FINES)
SANCTIONS = st.builds(
    law.GraduatedSanctions,
    freeze_steps=st.sampled_from([(0,), (2, 5), (1, 2, 3)]),
    fines=st.sampled_from([(0.0,), (1.0, 2.5)]),
    recovery_steps=st.sampled_from([None, 1, 4]),
    on=st.sampled_from(["tags", "violations", "both"]),
)


@st.composite
def governed_games(draw, *, harmless=False, ballots=True, **fixed):
    """Random games with up to seven institutions; `harmless`: only such as leave all but payments alone;
    without `ballots`: none in which agents decide anything."""
    game = draw(games(**fixed))
    fine = FINES if harmless else FINES | st.none()
    several = [
        boundaries(game.map, fine, FINES | st.none()),
        quotas(fine),
        st.builds(
            law.ClosedSeason, period_steps=st.integers(5, 9), closed_steps=st.integers(0, 5), fine=fine
        ),
        st.builds(law.Rotation, window_steps=st.integers(1, 9), fine=fine),
        taxes(),
        levies(game.agents),
    ]
    plain = taxes().map(lambda tax: replace(tax, brackets=()))
    if ballots:
        several.append(votes(plain | quotas(fine)))
    chosen = draw(st.lists(st.one_of(several), max_size=4))
    monitors = MONITORS if ballots else MONITORS.map(lambda own: replace(own, monitor=None))
    one_each = [monitors, st.builds(law.ClosedPatches, below=st.integers(0, 4), fine=fine), MEDIATIONS]
    if not harmless:
        sanctioners = st.just(law.Sanctioner(agents=(0,)))
        one_each += [SANCTIONS, sanctioners | st.just(law.Sanctioner()) if ballots else sanctioners]
    for kind in one_each:
        chosen += draw(st.lists(kind, max_size=1))
    if not any(isinstance(own, law.Mediation) for own in chosen):
        chosen.append(draw(quotas(FINES)))  # so that there is a rule to break
    order = draw(st.permutations(chosen))
    return replace(game, observation=Observation(agents_apart=True), institutions=tuple(order))


def random_decisions(steps, worlds, game, *, seed=0):
    """int64 [steps, worlds, N], every option equally likely."""
    shape = steps, worlds, game.agents
    return np.random.default_rng(seed + 1000).integers(0, max(1, game.decisions), shape)


def random_play(game, *, turns=40, worlds=2, seed=0, **options):
    """The moments of random play, from the begin on."""
    choices = [draw(turns, worlds, game, seed=seed) for draw in (random_actions, random_decisions)]
    return played(game, *choices, seed=seed, **options)
