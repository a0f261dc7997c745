"""The tragedy of the commons in a minute: agents who learn end worse off than agents who do not.

    python recipes/tragedy.py --watch serve --linger       4 replicas of 16 worlds, 300 episodes

Four independent DQN agents on `commons`, by the rules of the study as run. Each replica learns from sixteen
worlds at once, on a schedule ten times shorter than the published one, which recipes/commons.py has.
Copy this file and change it: another map, rule, network or loss is one line.
"""

from dataclasses import replace
from pathlib import Path

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning
from cprl.runs.curves import as_curves, curves_of, running_mean
from cprl.runs.episodes import read_table
from cprl.system.output import printed, say
from cprl.system.shipped import cprl_here

WORLDS = 16
SHORT = {
    "learning_rate": 1e-3,
    "epsilon_decay_steps": 100_000,
    "gamma": 0.97,
    "steps_per_update": WORLDS,  # so one update a turn
    "batch_size": 64,
}
"""What differs from the published schedule, besides the numbers of worlds and episodes."""

NEXT = """\
This was a short schedule. The published one, 8 replicas of 4,800 episodes, takes hours:
    {cprl} run commons --variant as_run
Three things to try next:
    {cprl} film {run} --out tragedy.gif
        one episode of the trained agents as a film
    {cprl} play {run}
        play among them yourself
    {cprl} run tragedy --game.rules.freeze-steps 100 --watch serve --linger
        another rule: who is hit by the beam stays out four times as long"""


def experiment() -> cprl.Experiment:
    """Four independent DQN agents on `commons`, on a short schedule."""
    settings = replace(presets.dqn_settings("commons", variant="as_run"), **SHORT)
    return cprl.Experiment(
        name="tragedy",
        game=presets.game("commons", variant="as_run"),
        agents=(Learning(DQN(settings=settings)),) * 4,
        episodes=300,
        replicas=4,
        worlds=WORLDS,
        evaluation_episodes=50,
    )


def course_of(run: Path) -> str:
    """What happened in sentences: the peak, what came after it, how long boards last, and what that means.

    A tragedy, here: the last 30 episodes yield at most 95 % of random play, the best ten at least 1.5 times
    as much as it, and boards last at most 70 % of the turns that they could.
    """
    curves = curves_of(run)
    if lacking := sorted({"collective_return", "survival_steps"} - set(curves)):
        raise ValueError(f"the episodes of {run} lack {', '.join(lacking)}; allowed: games that report them")
    returns, survival = curves["collective_return"].mean(0), curves["survival_steps"]
    tens, last, lasts = running_mean(returns, 10), returns[-30:].mean(), survival[:, -30:].mean()
    by_chance = as_curves(read_table(run / "evaluation" / "random.parquet"))["collective_return"]
    random, error = by_chance.mean(), by_chance.std(ddof=1) / by_chance.size**0.5
    peak, times, shares = tens.max(), "where random play gets none", []
    if peak:
        shares.append(f"{1 - last / peak:.0%} below that peak")
    if random:
        times = f"{peak / random:.1f} times the {random:.0f} ± {error:.0f} of random play"
        more = "less" if last < random else "more"
        shares.append(f"{abs(last / random - 1):.0%} {more} than random play gets")
    if random > 0 and last <= 0.95 * random and peak >= 1.5 * random and lasts <= 0.7 * survival.max():
        meaning = (
            "Each agent learned to take what pays now, and all of them, trained, end worse off than agents "
            "who never learned: the tragedy of the commons."
        )
    elif last > random:
        meaning = "They end better off than agents who never learned: no tragedy so far."
    else:
        meaning = "They end no better off than agents who never learned."
    return (
        f"The agents began at {tens[0]:.0f} apples an episode, all together, and reached {peak:.0f} "
        f"around episode {tens.argmax() + 5}, {times}. In the last {len(returns[-30:])} episodes they got "
        f"{last:.0f}{', ' * bool(shares)}{' and '.join(shares)}. "
        f"Boards that can last {survival.max():.0f} steps now last {lasts:.0f}. {meaning}"
    )


def tell(run: Path) -> None:
    """Says what happened, and what to try next."""
    say(course_of(run))
    say(NEXT.format(run=printed([str(run)]), cprl=printed(cprl_here())))


if __name__ == "__main__":
    cprl.recipe_main(experiment, at_end=tell)
