"""The study's claims on experiments 1 to 4: of one agent, and of two."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cprl.commons.game import Game
from cprl.envs.commons_env import CommonsEnv
from cprl.evaluation.evaluate import SEED
from cprl.measuring.evaluate import evaluate
from cprl.measuring.published import curve
from cprl.policies.assignment import AgentPolicies
from cprl.policies.scripted import ScriptedActor
from cprl.reporting.claims import Claim, alike, more, number, side, where
from cprl.reporting.measures import NEARNESS, OVERLAP, ROUNDS, dip_depth, falls
from cprl.reporting.random_play import returns_by_chance
from cprl.reporting.result import Result
from cprl.runs.curves import running_mean

Values = NDArray[np.float64]

EARLY = 600
"""The dip of experiment 1 is looked for before this episode."""
LAST = 500
"""The episodes at the end of a training that stand for what was learned."""
GREEDY_WORLDS = 1_000


def of_experiment_1(result: Result) -> Iterator[Claim]:
    """It learns where the apples are, strips them near episode 300, and recovers."""
    early = running_mean(result.curves["collective_return"], result.window)[:, :EARLY]
    published, is_long = _published(result, EARLY), early.shape[1] >= EARLY
    depth, at = dip_depth(published)[0], _dip_at(published)[0]
    yield where(is_long, number("a dip in the early training", _DIP, dip_depth(early), published=depth))
    yield where(is_long, number("the dip is near episode 300", "its episode", _dip_at(early), published=at))
    late = result.curves["collective_return"][:, -LAST:].mean(1)
    measure = "return of the last 500 episodes, and lowest in the dip"
    recovers = more("then it recovers", measure, late, _dip_bottom(early), paired=True)
    yield where(result.is_whole, recovers)


def of_experiment_2(result: Result) -> Iterator[Claim]:
    """No dip, since depletion pays as much as random play; a policy that circles."""
    early = running_mean(result.curves["collective_return"], result.window)[:, :EARLY]
    depth = dip_depth(_published(result, EARLY))[0]
    yield where(early.shape[1] >= EARLY, number("no dip", _DIP, dip_depth(early), published=depth))
    game = result.experiment.game
    if isinstance(game, Game):
        ratio = _greedy_returns(game) / returns_by_chance(game).mean()
        measure = "scripted greedy agent's return over random play's, 1,000 episodes"
        claim = "greedy depletion earns about what random play does"
        yield alike(claim, measure, ratio, within=(0.8, 1.2))
    yield from _circles(result)


def of_experiment_3(result: Result, others: Sequence[Result]) -> Iterator[Claim]:
    """Two learners get more than one, alike, in territories, use the beam less and less, and sustain."""
    own = result.over_training("collective_return")
    alone = [one for one in others if one.study and one.study.number == 2]
    for one in alone:
        measure = f"mean over training, and that of {one.name}; published 191.7 and 177.4"
        claim = "the sum is about 8 % above experiment 2"
        above = more(claim, measure, own, one.over_training("collective_return"), paired=False)
        yield where(result.is_whole and one.is_whole, above)
    played = result.measures
    ratio = played.training["return of the poorest agent over that of the richest, whole training"]
    claim, measure = "both earn almost the same", "the lower mean over training over the higher one"
    yield where(result.is_whole, alike(claim, measure, ratio, within=(0.8, 1.2)))
    if OVERLAP in played.trained:
        measure = "overlap of the cells that the two visit, random agents' and theirs"
        yield more(
            "they split the board", measure, played.random[OVERLAP], played.trained[OVERLAP], paired=True
        )
    if NEARNESS in played.trained:
        yield side("they fire mostly when close", NEARNESS, played.trained[NEARNESS], below=1)
    shots = result.of_agents("shots")
    ends = result.exploration_ends
    if shots is not None and shots.any() and shots.shape[1] >= 2 * LAST:
        total = shots.sum(2)
        late, claim = total[:, -LAST:].mean(1), "the use of the beam declines"
        yield more(claim, "shots an episode, first and last 500", total[:, :LAST].mean(1), late, paired=True)
        if ends is not None and int(ends) + 2 * LAST <= shots.shape[1]:
            after = total[:, int(ends) : int(ends) + LAST].mean(1)
            measure = "the same, of the 500 after exploration, and the last 500"
            yield more("and beyond the end of exploration", measure, after, late, paired=True)
    yield from _lasts(result, "two manage the resource sustainably")


def of_experiment_4(result: Result, others: Sequence[Result]) -> Iterator[Claim]:
    """The learner outdoes a random agent, tags it now and then when near, circles, and prevents depletion."""
    learner, walker = (running_mean(result.curves[f"return_{agent}"], result.window) for agent in (0, 1))
    at, published = curve("exp4_agents/return_random")
    fallen = slice(450, 550)
    if walker.shape[1] >= fallen.stop:
        early = (at >= fallen.start) & (at < fallen.stop)
        values = walker[:, fallen].mean(1)
        measure = "its running means at episodes 450 to 550"
        claim = "the random agent's return falls until about episode 500"
        yield number(claim, measure, values, published=published[early].mean())
        measure = "first running mean, and those at episodes 450 to 550"
        yield more("it falls", measure, walker[:, 0], values, paired=True)
        measure = "running means at episodes 450 to 550, and the first"
        claim = "while the learner's rises"
        yield more(claim, measure, learner[:, fallen].mean(1), learner[:, 0], paired=True)
    values, measure = result.over_training("return_1"), "its mean over training"
    gets = number("the random agent gets 28.9 apples", measure, values, published=28.9)
    yield where(result.is_whole, gets)
    played, of_learner = result.measures, f"{NEARNESS}, agent 0"
    if of_learner in played.trained:
        yield side("it tags when near", of_learner, played.trained[of_learner], below=1)
    shots = result.of_agents("shots")
    if shots is not None:
        late = shots[:, -LAST:, 0].mean(1)
        measure = "the learner's shots an episode, a random agent's and its own, last 500"
        tags = more("it tags occasionally", measure, shots[:, -LAST:, 1].mean(1), late, paired=True)
        yield where(result.is_whole, tags)
    yield from _circles(result)
    yield from _lasts(result, "it prevents depletion")
    empty, pairs = _ends_empty(result), [one for one in others if one.study and one.study.number == 3]
    for one in pairs:
        theirs = _ends_empty(one)
        if empty is not None and theirs is not None:
            measure = f"episodes of the last 500 that end empty, {one.name} and here"
            better = more("and better than two learners", measure, theirs, empty, paired=False)
            yield where(result.is_whole and one.is_whole, better)


_DIP = "deepest fall below the peak so far before episode 600, as a share of it"


def _published(result: Result, episodes: int) -> Values:
    """The published return of each of the first episodes, [1, episodes]."""
    assert result.study is not None
    found: Values = np.interp(np.arange(episodes), *curve(result.study.curves["collective_return"]))[None]
    return found


def _dip_at(curves: Values) -> Values:
    deepest: Values = falls(curves).argmax(1).astype(np.float64)
    return deepest


def _dip_bottom(curves: Values) -> Values:
    lowest: Values = curves[np.arange(len(curves)), _dip_at(curves).astype(int)]
    return lowest


def _greedy_returns(game: Game) -> Values:
    """The returns of an episode in each of `GREEDY_WORLDS` worlds of a single agent that goes for the nearest
    apple."""
    seeds, everyone = [(SEED, agent) for agent in range(game.agents)], tuple(range(game.agents))
    actor = ScriptedActor("greedy", game, seeds=seeds, agents=game.agents, worlds=GREEDY_WORLDS)
    played = evaluate(CommonsEnv(game, GREEDY_WORLDS, seed=SEED), AgentPolicies({everyone: actor}))
    return np.array([float(episode.return_.sum()) for episode in played])


def _circles(result: Result) -> Iterator[Claim]:
    name, played = ROUNDS.format(agent=0), result.measures
    if name in played.trained:
        measure = "rounds about the centre per 1000 steps, the learner's and a random agent's"
        yield more(
            "its policy circles the board", measure, played.trained[name], played.random[name], paired=True
        )


def _ends_empty(result: Result) -> Values | None:
    """The share of the last episodes of each replica that end without an apple, [R]."""
    ended = result.of_agents("terminated")
    return None if ended is None else ended[:, -LAST:, 0].mean(1)


def _lasts(result: Result, claim: str) -> Iterator[Claim]:
    empty = _ends_empty(result)
    if empty is not None:
        measure = "share of the last 500 episodes that end empty, sustainable if below a half"
        yield where(result.is_whole, side(claim, measure, empty, below=0.5))
