"""The study's claims on its five experiments: the measure of each, its interval over replicas, a verdict."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import verdicts
from numpy.typing import NDArray
from phases import PHASES_BEGIN
from possible import possible
from published import curve
from results import (
    LAST,
    NEARNESS,
    OVERLAP,
    ROUNDS,
    TOO_FEW,
    Result,
    dip_depth,
    falls,
    returns_by_chance,
    with_interval,
)
from tragedies import Definition, by_definition, shares_by_definition
from verdicts import prediction, share

from cprl.commons.game import Game
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.evaluate import evaluate
from cprl.measuring.statistics import difference, estimate
from cprl.measuring.windows import running_mean
from cprl.policies.assignment import AgentPolicies
from cprl.policies.scripted import ScriptedActor
from cprl.system.defaults import SEED

Values = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim of the study beside a run of ours, as a row of a table."""

    claim: str
    measure: str
    published: str
    """What the study's own figures say; "" where they cannot."""
    ours: str
    verdict: str


def number(claim: str, measure: str, values: Values, *, published: float) -> Claim:
    """A number that the study's figures give, beside the prediction interval of one run.

    Args:
        claim: what the study says.
        measure: what is measured.
        values: of each replica, [R].
        published: the same of the published curve.
    """
    return Claim(
        claim=claim,
        measure=measure,
        published=f"{published:.4g}",
        ours=f"{with_interval(values)}, one run {prediction(values)}",
        verdict=verdicts.of_number(published, values),
    )


def side(
    claim: str,
    measure: str,
    values: Values,
    *,
    above: float | None = None,
    below: float | None = None,
    published: float | None = None,
) -> Claim:
    """A mean that is claimed to lie above or below a bound; see `verdicts.of_claim`."""
    found = estimate(values)
    return Claim(
        claim=claim,
        measure=measure,
        published="" if published is None else f"{published:.4g}",
        ours=with_interval(values),
        verdict=verdicts.of_claim(found.low, found.high, above=above, below=below, replicas=len(values)),
    )


def more(claim: str, measure: str, values: Values, reference: Values, *, paired: bool) -> Claim:
    """A mean that is claimed to exceed another one, [R] each; see `verdicts.of_claim`."""
    found = difference(values, reference, paired=paired)
    return Claim(
        claim=claim,
        measure=measure,
        published="",
        ours=f"{values.mean():.4g} and {reference.mean():.4g}, difference {found:.4g}",
        verdict=verdicts.of_claim(found.low, found.high, above=0, replicas=min(len(values), len(reference))),
    )


def alike(claim: str, measure: str, values: Values, *, within: tuple[float, float]) -> Claim:
    """A mean that is claimed to lie between two bounds; see `verdicts.of_likeness`."""
    found = estimate(values)
    return Claim(
        claim=claim,
        measure=f"{measure}, alike if {within[0]:g} to {within[1]:g}",
        published="",
        ours=with_interval(values),
        verdict=verdicts.of_likeness(found.low, found.high, within=within, replicas=len(values)),
    )


def rule(claim: str, measure: str, shown: NDArray[Any]) -> Claim:
    """What more than half of all runs are claimed to show, bool [R]; see `verdicts.of_share`."""
    found = share(int(shown.sum()), len(shown))
    return Claim(
        claim=claim,
        measure=f"{measure}; share of replicas",
        published="",
        ours=f"{found}",
        verdict=verdicts.of_share(found),
    )


def rule_by_definition(claim: str, measure: str, shown: Mapping[Definition, NDArray[Any]]) -> Claim:
    """The same by each definition of what is shown, bool [R] each, the main one first; see
    `verdicts.of_definitions`."""
    main, *_ = each = [share(int(own.sum()), len(own)) for own in shown.values()]
    return Claim(
        claim=claim,
        measure=f"{measure}; share of replicas, and by other windows and falls",
        published="",
        ours=f"{main}, {shares_by_definition(each)}",
        verdict=verdicts.of_definitions([verdicts.of_share(one) for one in each]),
    )


def where(is_long: bool, claim: Claim) -> Claim:
    """A claim; its verdict says so where the training is too short for it."""
    return claim if is_long else replace(claim, verdict=TOO_FEW)


def undefined_in(values: Values) -> str:
    """In how many episodes a metric is undefined, which are in no mean, [R, E]; "" in none."""
    count = int(np.isnan(values).sum())
    return f", undefined in {count:,} of {values.size:,} episodes" if count else ""


def rows_of(claims: Sequence[Claim]) -> list[list[str]]:
    """The cells of a table of claims; see `HEAD`."""
    return [[one.claim, one.measure, one.published, one.ours, one.verdict] for one in claims]


HEAD = ["claim", "measure", "published", "ours", "verdict"]
"""The head of a table of claims."""

EARLY = 600
"""The dip of experiment 1 is looked for before this episode."""
OPTIMAL: Final = 0.9
"""The least share of the best known harvest that counts as an optimal strategy. What is best may be more than
what is best known, so that a smaller share contradicts the claim, and a larger one is no proof of it."""
GREEDY_WORLDS = 1_000


def of_experiment_1(result: Result) -> Iterator[Claim]:
    """It learns where the apples are, strips them near episode 300, recovers, and ends at its optimum."""
    early = running_mean(result.curves["collective_return"], result.window)[:, :EARLY]
    published, is_long = _published_returns(result, EARLY), early.shape[1] >= EARLY
    depth, at = dip_depth(published)[0], _dip_at(published)[0]
    yield where(is_long, number("a dip in the early training", _DIP, dip_depth(early), published=depth))
    yield where(is_long, number("the dip is near episode 300", "its episode", _dip_at(early), published=at))
    late = result.curves["collective_return"][:, -LAST:].mean(1)
    measure = "return of the last 500 episodes, and lowest in the dip"
    recovers = more("then it recovers", measure, late, _dip_bottom(early), paired=True)
    yield where(result.is_whole, recovers)
    yield from _lasts(result, "it manages the resource sustainably in the end")
    yield from _is_optimal(result)


def of_experiment_2(result: Result) -> Iterator[Claim]:
    """No dip, since depletion pays as much as random play; a policy that circles, sustains and is optimal."""
    early = running_mean(result.curves["collective_return"], result.window)[:, :EARLY]
    depth = dip_depth(_published_returns(result, EARLY))[0]
    yield where(early.shape[1] >= EARLY, number("no dip", _DIP, dip_depth(early), published=depth))
    game = result.experiment.game
    if isinstance(game, Game):
        ratio = _greedy_returns(game) / returns_by_chance(game).mean()
        measure = "scripted greedy agent's return over random play's, 1,000 episodes"
        claim = "greedy depletion earns about what random play does"
        yield alike(claim, measure, ratio, within=(0.8, 1.2))
    yield from _circles(result)
    yield from _lasts(result, "it manages the resource sustainably in the end")
    yield from _is_optimal(result)


def of_experiment_3(result: Result, others: Sequence[Result]) -> Iterator[Claim]:
    """Two learners get more than one, alike, in territories, use the beam less and less, and sustain."""
    own = result.over_training("collective_return")
    played, rounds = result.measures, [ROUNDS.format(agent=agent) for agent in range(2)]
    alone = [one for one in others if one.study and one.study.number == 2]
    for one in alone:
        measure = f"mean over training, and that of {one.name}; published 191.7 and 177.4"
        claim = "the sum is about 8 % above experiment 2"
        above = more(claim, measure, own, one.over_training("collective_return"), paired=False)
        yield where(result.is_whole and one.is_whole, above)
        if rounds[0] in one.measures.trained and rounds[1] in played.trained:
            measure = f"rounds about the centre per 1000 steps, {one.name}'s and the mean of the two"
            circling = np.mean([played.trained[name] for name in rounds], axis=0)
            claim = "they do not circle as in experiment 2"
            yield more(claim, measure, one.measures.trained[rounds[0]], circling, paired=False)
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


def _published_returns(result: Result, episodes: int) -> Values:
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


def _ends_empty(result: Result, part: slice = slice(-LAST, None)) -> Values | None:
    """The share of some episodes of each replica, by default the last, that end without an apple, [R]."""
    ended = result.of_agents("terminated")
    return None if ended is None else ended[:, part, 0].mean(1)


def _lasts(result: Result, claim: str) -> Iterator[Claim]:
    empty = _ends_empty(result)
    if empty is not None:
        measure = "share of the last 500 episodes that end empty, sustainable if below a half"
        yield where(result.is_whole, side(claim, measure, empty, below=0.5))


def _is_optimal(result: Result) -> Iterator[Claim]:
    """The share of the best known harvest at the end of training, and of what was learned in new worlds."""
    game = result.experiment.game
    if not isinstance(game, Game):
        return
    best = possible(game).best_known
    late = result.curves["collective_return"][:, -LAST:].mean(1)
    claim = "it converges to the optimal strategy"
    measure = f"harvest of the last {LAST} episodes over the best known, {best:.0f} apples"
    of_training = side(claim, f"{measure}; optimal if above {OPTIMAL:g}", late / best, above=OPTIMAL)
    yield where(result.is_whole, of_training)
    played = result.evaluated("trained")
    if played is not None:
        measure = f"the same of trained agents in new worlds; optimal if above {OPTIMAL:g}"
        share_of_best = played["collective_return"] / best
        yield where(result.is_whole, side(claim, measure, share_of_best, above=OPTIMAL))


EXPLORED, TRAGIC, FOUGHT = PHASES_BEGIN
"""The episodes at which the study's phases of exploration, tragedy and combat end."""


def of_experiment_5(result: Result) -> Iterator[Claim]:
    """Exploration, tragedy, combat, cultivation."""
    curves, returns = result.curves, running_mean(result.curves["collective_return"], result.window)
    episodes, ends = returns.shape[1], result.exploration_ends
    if ends is not None and 0 < int(ends) < episodes:
        best, after = returns[:, : int(ends)].max(1), returns[:, int(ends) :].max(1)
        measure = f"highest running mean before and after episode {ends:.0f}, where exploration ends"
        yield more("the highest returns come in exploration", measure, best, after, paired=True)
    yield from _climbs(
        result, "exploration: peacefulness rises", "peacefulness", slice(0, EXPLORED), above=0.0
    )
    yield from _climbs(
        result, "exploration: equality falls slowly", "equality", slice(0, EXPLORED), below=0.0
    )
    yield from _stays_healthy(result)
    yield from _climbs(result, "tragedy: equality falls", "equality", slice(EXPLORED, TRAGIC), below=0.0)
    survival = running_mean(curves["survival_steps"], result.window).min(1)
    at, values = _published_curve(result, "survival_steps")
    falls = number(
        "survival falls to 612 steps", "lowest running mean", survival, published=float(values.min())
    )
    yield where(episodes > at[values.argmin()], falls)
    if each := by_definition(result):
        measure = "return, survival and peacefulness fall together"
        yield rule_by_definition("tragedy", measure, {name: own.tragedy for name, own in each.items()})
        measure = "return rises again, peacefulness below its peak"
        yield rule_by_definition("combat follows", measure, {name: own.combat for name, own in each.items()})
    if episodes >= FOUGHT + LAST:
        ratio = _unrest(returns[:, TRAGIC:FOUGHT]) / _unrest(returns[:, FOUGHT:])
        at, values = _published_curve(result, "collective_return")
        theirs = np.interp(np.arange(at[-1]), at, values)[None]
        yield side(
            "combat is volatile, cultivation is not",
            f"scatter of running means about their line, episodes {TRAGIC} to {FOUGHT} over later ones",
            ratio,
            above=1,
            published=float((_unrest(theirs[:, TRAGIC:FOUGHT]) / _unrest(theirs[:, FOUGHT:]))[0]),
        )
        at, values = _published_curve(result, "equality")
        late = float(values[at >= at[-1] - LAST].mean())
        equality = curves["equality"][:, -LAST:]
        yield number(
            "equality about 0.87 in the end",
            f"mean of the last 500 episodes{undefined_in(equality)}",
            np.nanmean(equality, axis=1),
            published=late,
        )
    yield from _tagging(result)
    yield from _lasts(result, "four manage the resource sustainably in the end")
    yield from _raises_returns(result)


def _climbs(result: Result, claim: str, metric: str, part: slice, **bound: float) -> Iterator[Claim]:
    """That a metric climbs above or below a bound in a part of the training."""
    values = result.curves[metric]
    if values.shape[1] >= part.stop:
        first, later = f"over the first {part.stop} episodes", f"from episode {part.start} to {part.stop}"
        measure = f"climb of its line {later if part.start else first}"
        published = _published_climb(result, metric, part)
        yield side(claim, measure, _climb(values[:, part]), published=published, **bound)


def _stays_healthy(result: Result) -> Iterator[Claim]:
    empty = _ends_empty(result, slice(EXPLORED))
    if empty is not None and result.curves["survival_steps"].shape[1] >= EXPLORED:
        measure = f"share of the first {EXPLORED} episodes that end empty, healthy if below a half"
        yield side("exploration: the stock stays healthy", measure, empty, below=0.5)


def _raises_returns(result: Result) -> Iterator[Claim]:
    game, study = result.experiment.game, result.study
    if isinstance(game, Game) and study is not None and study.random is not None:
        raised = side(
            "learning need not raise returns",
            "mean return over training less random play's; no rise if at most 0",
            result.over_training("collective_return") - returns_by_chance(game).mean(),
            published=study.trained - study.random,
            below=0.0,
        )
        yield where(result.is_whole, raised)


def _tagging(result: Result) -> Iterator[Claim]:
    shots, tagged = result.of_agents("shots"), result.of_agents("tagged")
    if shots is None or tagged is None or shots.shape[1] < EXPLORED + LAST:
        return
    parts = {"the first 450 episodes": slice(0, EXPLORED)}
    if shots.shape[1] >= FOUGHT + LAST:
        parts[f"episodes {TRAGIC} to {FOUGHT}"] = slice(TRAGIC, FOUGHT)
    late = _per(tagged[:, -LAST:], shots[:, -LAST:])
    for name, part in parts.items():
        yield more(
            "cultivation: efficient tagging",
            f"tags per shot, last 500 episodes and {name}",
            late,
            _per(tagged[:, part], shots[:, part]),
            paired=True,
        )


def _published_curve(result: Result, metric: str) -> tuple[Values, Values]:
    assert result.study is not None
    return curve(result.study.curves[metric])


def _published_climb(result: Result, metric: str, part: slice) -> float:
    at, values = _published_curve(result, metric)
    inside = (at >= part.start) & (at <= part.stop)
    return float(np.polyfit(at[inside], values[inside], 1)[0] * (part.stop - part.start))


def _climb(curves: Values) -> Values:
    """The climb of the straight line through each curve from its first to its last episode, [R, E] to [R];
    episodes in which it is undefined are left out."""
    episodes = curves.shape[1]
    at = np.arange(episodes)
    return np.array([np.polyfit(at[~np.isnan(own)], own[~np.isnan(own)], 1)[0] * episodes for own in curves])


def _unrest(curves: Values) -> Values:
    """The standard deviation of each curve about its straight line, [R, E] to [R]."""
    at = np.arange(curves.shape[1])
    return np.array([(own - np.polyval(np.polyfit(at, own, 1), at)).std() for own in curves])


def _per(part: Values, whole: Values) -> Values:
    """The sum of one over that of the other, [R, E, N] each to [R]."""
    ratio: Values = part.sum((1, 2)) / np.maximum(whole.sum((1, 2)), 1)
    return ratio
