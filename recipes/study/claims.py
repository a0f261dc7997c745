"""Do the study's claims on its five experiments hold? The measure of each, its interval, a verdict."""

from collections.abc import Iterator, Sequence
from math import inf
from typing import Any, Final, NamedTuple

import numpy as np
from measures import NEARNESS, OVERLAP, ROUNDS, deepest_dip, ratio, with_interval
from page import table
from phases import PHASES_BEGIN
from possible import possible
from random_play import random_returns
from results import LAST, TOO_FEW, Result
from tragedies import by_definition, judged_texts, shares_of
from verdicts import Share, judge_bounds, judge_number, prediction

from cprl.commons.game import Game
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.playing import evaluate
from cprl.measuring.statistics import difference, estimate
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.scripted import Plan, ScriptedActor
from cprl.system.defaults import SEED
from cprl.values.array_types import Float64


class Claim(NamedTuple):
    """A claim of the study beside a run of ours, as a row of a table."""

    claim: str
    measure: str
    published: str
    """The number of the study's own figures; "" where they have none."""
    ours: str
    verdict: str


def sections(results: Sequence[Result]) -> list[str]:
    """Return a table of the study's claims for each of its runs; nothing without any."""
    lines = ["## Claims", ""]
    for result in results:
        claims = EXPERIMENTS[result.study.number](result, results)
        lines += [f"### {result.name}", "", *table(Claim._fields, list(claims))]
    return lines if results else []


def number(claim: str, measure: str, values: Float64, published: float) -> Claim:
    """Return the claim of a number that the study's figures give, beside the interval of one run.

    Args:
        values: of each replica, [R].
        published: the same of the published curve.
    """
    ours = f"{with_interval(values)}, one run {prediction(values)}"
    return Claim(claim, measure, f"{published:.4g}", ours, judge_number(published, values))


def bounds(
    claim: str,
    measure: str,
    values: Float64,
    *,
    least: float = -inf,
    most: float = inf,
    published: float | None = None,
) -> Claim:
    """Return the claim that a mean over replicas, [R], lies between two bounds."""
    mean = estimate(values)
    verdict = judge_bounds(mean.low, mean.high, least=least, most=most, replicas=len(values))
    theirs = "" if published is None else f"{published:.4g}"
    return Claim(claim, measure, theirs, with_interval(values), verdict)


def more(claim: str, measure: str, values: Float64, reference: Float64, *, paired: bool = True) -> Claim:
    """Return the claim that a mean over replicas exceeds another one, [R] each."""
    change = difference(values, reference, paired=paired)
    ours = f"{values.mean():.4g} and {reference.mean():.4g}, difference {change:.4g}"
    replicas = min(len(values), len(reference))
    return Claim(claim, measure, "", ours, judge_bounds(change.low, change.high, least=0, replicas=replicas))


def rule(claim: str, measure: str, shares: Sequence[Share]) -> Claim:
    """Return the claim that more than half of all runs show something, from the share of replicas that do by
    each definition of it, the main one first."""
    main, counts, verdict = judged_texts(shares)
    measure = f"{measure}; share of replicas, and by other windows and falls"
    return Claim(claim, measure, "", f"{main}, {counts}", verdict)


def if_long(is_long: bool, claim: Claim) -> Claim:
    """Return a claim; its verdict says so where the training is too short for it."""
    return claim if is_long else claim._replace(verdict=TOO_FEW)


def undefined_text(values: Float64) -> str:
    """Return in how many episodes a metric is undefined, which are in no mean, [R, E]; "" in none."""
    count = int(np.isnan(values).sum())
    return f", undefined in {count:,} of {values.size:,} episodes" if count else ""


EARLY: Final = 600
"""The dip of experiment 1 is looked for before this episode."""
OPTIMAL: Final = 0.9
"""The least share of the best known harvest that counts as an optimal strategy. What is best may be more than
what is best known, so that a smaller share contradicts the claim, and a larger one is no proof of it."""
GREEDY_WORLDS: Final = 1_000


def experiment_1(result: Result, _: Sequence[Result] = ()) -> Iterator[Claim]:
    """Yield the claims that it learns where the apples are, strips them near episode 300, recovers, and ends
    at its optimum."""
    dip = deepest_dip(result.smoothed("collective_return")[:, :EARLY])
    published = _published_dip(result)
    is_long = result.smoothed("collective_return").shape[1] >= EARLY
    yield if_long(is_long, number("a dip in the early training", _DIP, dip.depth, published.depth[0]))
    at = number("the dip is near episode 300", "its episode", dip.episode, published.episode[0])
    yield if_long(is_long, at)
    measure = "return of the last 500 episodes, and lowest in the dip"
    recovers = more("then it recovers", measure, result.at_end("collective_return"), dip.bottom)
    yield if_long(result.is_whole, recovers)
    yield from _lasts(result, "it manages the resource sustainably in the end")
    yield from _is_optimal(result)


def experiment_2(result: Result, _: Sequence[Result] = ()) -> Iterator[Claim]:
    """Yield the claims that there is no dip, since depletion pays as much as random play, and that the policy
    circles, sustains and is optimal."""
    early = result.smoothed("collective_return")[:, :EARLY]
    no_dip = number("no dip", _DIP, deepest_dip(early).depth, _published_dip(result).depth[0])
    yield if_long(early.shape[1] >= EARLY, no_dip)
    game = result.experiment.game
    if isinstance(game, Game):
        claim = "greedy depletion earns about what random play does"
        measure = "scripted greedy agent's return over random play's, 1,000 episodes"
        yield _alike(claim, measure, _greedy_returns(game) / random_returns(game).mean())
    yield from _circles(result)
    yield from _lasts(result, "it manages the resource sustainably in the end")
    yield from _is_optimal(result)


def experiment_3(result: Result, others: Sequence[Result]) -> Iterator[Claim]:
    """Yield the claims that two learners get more than one, alike, in territories, use the beam less and
    less, and sustain."""
    trained = result.measures.trained
    total = result.over_training("collective_return")
    rounds = [ROUNDS.format(agent=agent) for agent in range(2)]
    for alone in _repeating(2, others):
        measure = f"mean over training, and that of {alone.name}; published 191.7 and 177.4"
        claim = "the sum is about 8 % above experiment 2"
        above = more(claim, measure, total, alone.over_training("collective_return"), paired=False)
        yield if_long(result.is_whole and alone.is_whole, above)
        if rounds[0] in alone.measures.trained and rounds[1] in trained:
            claim = "they do not circle as in experiment 2"
            measure = f"rounds about the centre per 1000 steps, {alone.name}'s and the mean of the two"
            circling = np.mean([trained[name] for name in rounds], axis=0)
            yield more(claim, measure, alone.measures.trained[rounds[0]], circling, paired=False)
    share = result.measures.training["return of the poorest agent over that of the richest, whole training"]
    measure = "the lower mean over training over the higher one"
    yield if_long(result.is_whole, _alike("both earn almost the same", measure, share))
    if OVERLAP in trained:
        measure = "overlap of the cells that the two visit, random agents' and theirs"
        yield more("they split the board", measure, result.measures.random[OVERLAP], trained[OVERLAP])
    if NEARNESS in trained:
        yield bounds("they fire mostly when close", NEARNESS, trained[NEARNESS], most=1)
    yield from _fires_less(result)
    yield from _lasts(result, "two manage the resource sustainably")


def _fires_less(result: Result) -> Iterator[Claim]:
    by_agent = result.by_agent("shots")
    if by_agent is None or not by_agent.any() or by_agent.shape[1] < 2 * LAST:
        return
    shots = by_agent.sum(2)
    late = shots[:, -LAST:].mean(1)
    measure = "shots an episode, first and last 500"
    yield more("the use of the beam declines", measure, shots[:, :LAST].mean(1), late)
    ends = result.exploration_ends
    if ends is not None and int(ends) + 2 * LAST <= shots.shape[1]:
        after = shots[:, int(ends) : int(ends) + LAST].mean(1)
        measure = "the same, of the 500 after exploration, and the last 500"
        yield more("and beyond the end of exploration", measure, after, late)


def experiment_4(result: Result, others: Sequence[Result]) -> Iterator[Claim]:
    """Yield the claims that the learner outdoes a random agent, tags it now and then when near, circles, and
    prevents depletion."""
    yield from _random_agent_falls(result)
    measure = "its mean over training"
    gets = number("the random agent gets 28.9 apples", measure, result.over_training("return_1"), 28.9)
    yield if_long(result.is_whole, gets)
    nearness = f"{NEARNESS}, agent 0"
    trained = result.measures.trained
    if nearness in trained:
        yield bounds("it tags when near", nearness, trained[nearness], most=1)
    shots = result.by_agent("shots")
    if shots is not None:
        learner, random = shots[:, -LAST:].mean(1).T
        measure = "the learner's shots an episode, a random agent's and its own, last 500"
        yield if_long(result.is_whole, more("it tags occasionally", measure, random, learner))
    yield from _circles(result)
    yield from _lasts(result, "it prevents depletion")
    empty = _ends_empty(result)
    for pair in _repeating(3, others):
        theirs = _ends_empty(pair)
        if empty is not None and theirs is not None:
            measure = f"episodes of the last 500 that end empty, {pair.name} and here"
            better = more("and better than two learners", measure, theirs, empty, paired=False)
            yield if_long(result.is_whole and pair.is_whole, better)


def _random_agent_falls(result: Result) -> Iterator[Claim]:
    learner = result.smoothed("return_0")
    random = result.smoothed("return_1")
    part = slice(450, 550)
    if random.shape[1] < part.stop:
        return
    at, published = result.study.curve("return_1")
    is_inside = (at >= part.start) & (at < part.stop)
    then = random[:, part].mean(1)
    claim = "the random agent's return falls until about episode 500"
    yield number(claim, "its running means at episodes 450 to 550", then, published[is_inside].mean())
    yield more("it falls", "first running mean, and those at episodes 450 to 550", random[:, 0], then)
    measure = "running means at episodes 450 to 550, and the first"
    yield more("while the learner's rises", measure, learner[:, part].mean(1), learner[:, 0])


_DIP: Final = "deepest fall below the peak so far before episode 600, as a share of it"


def _published_dip(result: Result) -> Any:
    return deepest_dip(result.study.drawn_at("collective_return", np.arange(EARLY))[None])


def _alike(claim: str, measure: str, ratios: Float64) -> Claim:
    return bounds(claim, f"{measure}, alike if 0.8 to 1.2", ratios, least=0.8, most=1.2)


def _repeating(number: int, results: Sequence[Result]) -> list[Result]:
    """Return the runs that repeat an experiment of the study."""
    return [result for result in results if result.study and result.study.number == number]


def _greedy_returns(game: Game) -> Float64:
    """Return the returns of an episode in each of `GREEDY_WORLDS` worlds of a single agent that goes for the
    nearest apple."""
    agents = range(game.agents)
    seeds = [(SEED, agent) for agent in agents]
    actor = ScriptedActor(Plan("greedy"), game, seeds=seeds, agents=game.agents, worlds=GREEDY_WORLDS)
    played = evaluate(CommonsEnv(game, GREEDY_WORLDS, seed=SEED), JointPolicy({tuple(agents): actor}))
    return np.array([float(episode.return_.sum()) for episode in played])


def _circles(result: Result) -> Iterator[Claim]:
    rounds = ROUNDS.format(agent=0)
    played = result.measures
    if rounds in played.trained:
        measure = "rounds about the centre per 1000 steps, the learner's and a random agent's"
        yield more("its policy circles the board", measure, played.trained[rounds], played.random[rounds])


def _ends_empty(result: Result, part: slice = slice(-LAST, None)) -> Float64 | None:
    """Return the share of some episodes of each replica, by default the last, that end without an apple."""
    ended = result.by_agent("terminated")
    return None if ended is None else ended[:, part, 0].mean(1)


def _lasts(result: Result, claim: str) -> Iterator[Claim]:
    empty = _ends_empty(result)
    if empty is not None:
        measure = "share of the last 500 episodes that end empty, sustainable if below a half"
        yield if_long(result.is_whole, bounds(claim, measure, empty, most=0.5))


def _is_optimal(result: Result) -> Iterator[Claim]:
    """Yield the claims on the share of the best known harvest, at the end of training and in new worlds."""
    game = result.experiment.game
    if not isinstance(game, Game):
        return
    best = possible(game).best_known
    measure = f"harvest of the last {LAST} episodes over the best known, {best:.0f} apples"
    harvests = {measure: result.at_end("collective_return")}
    played = result.evaluated("trained")
    if played is not None:
        harvests["the same of trained agents in new worlds"] = played["collective_return"]
    for measure, harvest in harvests.items():
        measure = f"{measure}; optimal if above {OPTIMAL:g}"
        optimal = bounds("it converges to the optimal strategy", measure, harvest / best, least=OPTIMAL)
        yield if_long(result.is_whole, optimal)


EXPLORED, TRAGIC, FOUGHT = PHASES_BEGIN
"""The episodes at which the study's phases of exploration, tragedy and combat end."""


def experiment_5(result: Result, _: Sequence[Result] = ()) -> Iterator[Claim]:
    """Yield the claims on exploration, tragedy, combat and cultivation."""
    study = result.study
    returns = result.smoothed("collective_return")
    episodes = returns.shape[1]
    ends = result.exploration_ends
    if ends is not None and 0 < int(ends) < episodes:
        before, after = np.split(returns, [int(ends)], axis=1)
        measure = f"highest running mean before and after episode {ends:.0f}, where exploration ends"
        yield more("the highest returns come in exploration", measure, before.max(1), after.max(1))
    explored = slice(0, EXPLORED)
    yield from _climbs(result, "exploration: peacefulness rises", "peacefulness", explored, least=0.0)
    yield from _climbs(result, "exploration: equality falls slowly", "equality", explored, most=0.0)
    empty = _ends_empty(result, explored)
    if empty is not None and result.curves["survival_steps"].shape[1] >= EXPLORED:
        measure = f"share of the first {EXPLORED} episodes that end empty, healthy if below a half"
        yield bounds("exploration: the stock stays healthy", measure, empty, most=0.5)
    yield from _climbs(result, "tragedy: equality falls", "equality", slice(EXPLORED, TRAGIC), most=0.0)
    at, values = study.curve("survival_steps")
    survival = result.smoothed("survival_steps").min(1)
    falls = number("survival falls to 612 steps", "lowest running mean", survival, values.min())
    yield if_long(episodes > at[values.argmin()], falls)
    if combats := by_definition(result):
        measure = "return, survival and peacefulness fall together"
        yield rule("tragedy", measure, shares_of([combats], "has_tragedy"))
        measure = "return rises again, peacefulness below its peak"
        yield rule("combat follows", measure, shares_of([combats], "has_combat"))
    if episodes >= FOUGHT + LAST:
        at, values = study.curve("collective_return")
        published = study.drawn_at("collective_return", np.arange(at[-1]))[None]
        measure = f"scatter of running means about their line, episodes {TRAGIC} to {FOUGHT} over later ones"
        unrest = {"values": _unrest(returns), "published": float(_unrest(published)[0])}
        yield bounds("combat is volatile, cultivation is not", measure, least=1, **unrest)
        at, values = study.curve("equality")
        equality = result.curves["equality"][:, -LAST:]
        measure = f"mean of the last 500 episodes{undefined_text(equality)}"
        late = values[at >= at[-1] - LAST].mean()
        yield number("equality about 0.87 in the end", measure, np.nanmean(equality, axis=1), late)
    yield from _tagging(result)
    yield from _lasts(result, "four manage the resource sustainably in the end")
    game = result.experiment.game
    if isinstance(game, Game) and study.random is not None:
        claim = "learning need not raise returns"
        measure = "mean return over training less random play's; no rise if at most 0"
        rise = result.over_training("collective_return") - random_returns(game).mean()
        raised = bounds(claim, measure, rise, most=0.0, published=study.trained - study.random)
        yield if_long(result.is_whole, raised)


EXPERIMENTS: Final = {1: experiment_1, 2: experiment_2, 3: experiment_3, 4: experiment_4, 5: experiment_5}
"""The claims of each experiment, from a run that repeats it and all other runs."""


def _climbs(result: Result, claim: str, metric: str, part: slice, **bound: float) -> Iterator[Claim]:
    """Yield the claim that a metric climbs above or below a bound in a part of the training."""
    curves = result.curves[metric]
    if curves.shape[1] < part.stop:
        return
    where = f"over the first {part.stop} episodes"
    if part.start:
        where = f"from episode {part.start} to {part.stop}"
    episodes = part.stop - part.start
    climbs = np.array(
        [_climb_per_episode(np.arange(episodes), curve) * episodes for curve in curves[:, part]]
    )
    at, values = result.study.curve(metric)
    is_inside = (at >= part.start) & (at <= part.stop)
    published = _climb_per_episode(at[is_inside], values[is_inside]) * episodes
    yield bounds(claim, f"climb of its line {where}", climbs, published=published, **bound)


def _climb_per_episode(at: Float64, curve: Float64) -> float:
    """Return the slope of the straight line through a curve; undefined values are left out."""
    is_defined = ~np.isnan(curve)
    return float(np.polyfit(at[is_defined], curve[is_defined], 1)[0])


def _unrest(curves: Float64) -> Float64:
    """Return the standard deviation of each curve about its straight line in combat, over that later, [R]."""

    def scatter(part: Float64) -> Float64:
        at = np.arange(part.shape[1])
        return np.array([(curve - np.polyval(np.polyfit(at, curve, 1), at)).std() for curve in part])

    return scatter(curves[:, TRAGIC:FOUGHT]) / scatter(curves[:, FOUGHT:])


def _tagging(result: Result) -> Iterator[Claim]:
    shots = result.by_agent("shots")
    tagged = result.by_agent("tagged")
    if shots is None or tagged is None or shots.shape[1] < EXPLORED + LAST:
        return
    parts = {"the first 450 episodes": slice(0, EXPLORED)}
    if shots.shape[1] >= FOUGHT + LAST:
        parts[f"episodes {TRAGIC} to {FOUGHT}"] = slice(TRAGIC, FOUGHT)

    def tags_per_shot(part: slice) -> Float64:
        return ratio(tagged[:, part].sum((1, 2)), shots[:, part].sum((1, 2)))

    late = tags_per_shot(slice(-LAST, None))
    for name, part in parts.items():
        measure = f"tags per shot, last 500 episodes and {name}"
        yield more("cultivation: efficient tagging", measure, late, tags_per_shot(part))
