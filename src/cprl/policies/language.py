"""LanguageActor: agents for which a language model makes plans.

Every some steps the model is shown what the agent observes, as text, and answers a plan as JSON: a scripted
policy and its numbers, which the agent follows until the next. In a game that is no `cprl.Game` it is shown
the numbers that the agent observes, and answers an action. Where an answer is bad or missing, the agent falls
back to a policy that was said beforehand. In games with talk an answer may hold a message, which the models
of the other agents of the world read in later turns.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from cprl import keys
from cprl.commons.cells import class_name
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.keys import recurrent_state
from cprl.pictures.decoding import SIGNS, window_text
from cprl.pictures.readable import instructions_of
from cprl.policies.actors import LaneActor
from cprl.policies.asking import Calls, Model, Question, Text
from cprl.policies.rng import Purpose, seed_of
from cprl.policies.scripted import (
    BEHAVIOURS,
    SCRIPTED_POLICIES,
    SPARE,
    Plan,
    ScriptedActor,
    ScriptedPolicy,
    can_tag,
    scripted_lanes,
)
from cprl.values import Natural, Positive, Range, Value, build, checked, refusal
from cprl.values.array_types import AnyArray, Float32, Int64

_TURN, _NEXT, _HARVEST, _PLAN = range(4)
"""The numbers that an agent carries from turn to turn: the turns of the episode so far, the turn of its next
plan, its harvest; and where those of the plan begin."""
_LARGEST_SEED: Final = 2**31


@dataclass(frozen=True, kw_only=True)
class Language(Model):
    """An agent whose plans a language model makes, see `cprl.policies.language`. It does not learn."""

    every_steps: Positive = 50
    """The steps from one plan to the next; as many as an episode has for a plan an episode."""
    fallback: ScriptedPolicy = "sustainable"
    """What it does where the model gives no plan; "random" in a game that is no `cprl.Game`."""
    instructions: Text = ""
    """Text before all else: a persona, a norm, or what a game of your own is about."""


@dataclass(frozen=True, kw_only=True)
class _Answer(Value, stored=False):
    """What a model may say beside what its agent does."""

    why: str = ""
    message: Text = ""


@dataclass(frozen=True, kw_only=True)
class _PlanAnswer(Plan, _Answer, stored=False):
    signal: Natural = 0
    """The signal that the agent sends in each turn, see `Rules.signals`; 0 for none."""


@dataclass(frozen=True, kw_only=True)
class _ActionAnswer(_Answer, stored=False):
    action: Natural


def _form(entries: dict[str, Any], *, talks: bool) -> str:
    """Return what a model has to know about the form of its answer.

    Args:
        entries: an example of each entry, and what it is.
        talks: whether agents send each other messages.
    """
    entries = {"why": ("...", "a short reason"), **entries}
    if talks:
        entries["message"] = "...", "a text that all other agents read with their next question"
    example = json.dumps({name: value for name, (value, _) in entries.items()})
    meanings = " ".join(f'"{name}" is {meaning}.' for name, (_, meaning) in entries.items())
    return f"Answer with one JSON object and nothing else, in this form:\n{example}\n{meanings}"


class _BoardPlans:
    """Plans on a board: the numbers of a `Plan`, and last a signal.

    Args:
        game: the game that is played.
        script: follows the policies; its own is the fallback.
    """

    def __init__(self, game: Game, script: ScriptedActor) -> None:
        self.game = game
        self.talks = game.rules.signals > 0
        """Whether agents send each other messages."""
        self.fallback = (*Plan(script.policy).numbers(game), 0)
        """The numbers of the plan of an agent without an answer."""
        self._widest = self.fallback[2:4]
        """The region of an agent that harvests wherever it sees."""
        self.in_keys = (keys.HARVEST[1], keys.IN_PLAY[1], *script.in_keys[1:])
        """The entries of "agents" that it reads beside observations."""
        self._script = script

    def rules(self, spec: Language) -> str:
        """Return what a model has to know before it answers."""
        rows, columns = self._widest
        where = f"the rows ahead, 0 to {rows}, and columns to each side, 0 to {columns}, where you harvest"
        entries: dict[str, Any] = {
            "policy": ("...", "a name of the list"),
            "spare": (SPARE, "1 to 8"),
            "region": (self._widest, where),
        }
        if can_tag(self.game):
            entries["tag"] = [1], "at whom you fire; leave it out to fire as the policy says"
        if self.talks:
            entries["signal"] = 0, f"0 to {self.game.rules.signals}, which others see"
        return "\n".join(
            [
                f"You are one of {self.game.agents} agents on a board.",
                *instructions_of(self.game, "window"),
                "Each apple that you pick is a point for you.",
                f"Every {spec.every_steps} turns you choose a plan, which is played for you.",
                _form(entries, talks=self.talks),
                *(f'- "{policy}": {behaviour}' for policy, behaviour in BEHAVIOURS.items()),
            ]
        )

    def seen(self, observation: AnyArray, memory: Float32) -> str:
        """Return in words what an agent observes, and carries from turn to turn."""
        turn, _, harvest, *plan = memory.astype(np.int64).tolist()
        lines = [f"Turn {turn + 1} of {self.game.rules.episode_steps}. You picked {harvest} apples so far."]
        if turn:
            lines.append(f"Your last plan: {self._in_words(plan)}.")
        lines += self._planes(observation)
        signs = ", ".join(f"{SIGNS.get(kind, 'O')} {class_name(kind)}" for kind in self.game.cell_classes)
        return "\n".join(
            [*lines, f"What you see, ahead is up ({signs}):", window_text(self.game, observation)]
        )

    def _in_words(self, plan: Sequence[int]) -> str:
        policy, spare, rows, columns, *foes, signal = plan
        region = f", region {rows}, {columns}" * ((rows, columns) != self._widest)
        tag = f", tag {np.flatnonzero(foes).tolist()}" * (can_tag(self.game) and any(foes))
        said = f", signal {signal}" * bool(signal)
        return f"{SCRIPTED_POLICIES[policy]}, spare {spare}{region}{tag}{said}"

    def _planes(self, observation: AnyArray) -> list[str]:
        """Return in words what the channels beside those of the board show, where the game has them."""
        game = self.game
        lines = []
        for number in range(1, game.rules.signals + 1):
            senders = np.count_nonzero(self._entries(observation, f"signal {number}"))
            lines += [f"Signal {number} was sent by {senders} of those you see."] * bool(senders)
        if game.observation.scoreboard:
            bytes_ = self._entries(observation, "scoreboard")[: game.agents].astype(np.int64)
            scores = len(game.map.sites) * bytes_ / np.maximum(1, 255 - bytes_)
            words = ", ".join(f"{score:.0f}" for score in scores.tolist())
            lines.append(f"Apples picked by you and the next agents: {words}.")
        if game.observation.stock_gauge:
            share = self._entries(observation, "stock_gauge")[0] / 255
            lines.append(f"Of all places for apples {share:.0%} have one.")
        if game.entries_shown:
            values = self._entries(observation, "institutions") / 255
            entries = zip(game.entries_shown, values.tolist(), strict=False)
            lines.append("; ".join(f"{name}: {value:.2f}" for name, value in entries))
        return lines

    def _entries(self, observation: AnyArray, channel: str) -> AnyArray:
        """Return the numbers that the channels of a name show."""
        return observation[np.array(self.game.channels) == channel].reshape(-1)

    def read(self, table: Any) -> tuple[_Answer, tuple[int, ...]]:
        """Return an answer, and its plan as numbers; raise a ValueError if it is not allowed."""
        answer = build(_PlanAnswer, table, "answer")
        checked("answer.signal", answer.signal, Annotated[int, Range(0, self.game.rules.signals)])
        return answer, (*answer.numbers(self.game), answer.signal)

    def act(self, plans: Int64, tensordict: TensorDictBase) -> Int64:
        """Return actions, int64 [B, S], by plans, [B, S, 5 + N]."""
        seen = map(tensordict.get, self._script.in_keys)
        silent = self._script.choose(*seen, plans=plans[..., :-1]).numpy(force=True)
        return silent + plans[..., -1] * self.game.tables.silent_actions


class _PlainActions:
    """Actions in a game that is no `cprl.Game`, which shows its agents numbers; a plan is an action."""

    in_keys = ()
    fallback = (-1,)

    def __init__(self, spaces: Spaces, script: LaneActor) -> None:
        self.talks = spaces.talk
        self._actions = spaces.actions
        self._script = script

    def rules(self, spec: Language) -> str:
        every = "each turn" if spec.every_steps == 1 else f"every {spec.every_steps} turns"
        form = _form({"action": (0, f"an integer from 0 to {self._actions - 1}")}, talks=self.talks)
        return f"You choose an action {every}.\n{form}"

    def seen(self, observation: AnyArray, memory: Float32) -> str:
        turn = int(memory[_TURN])
        last = f" Your last action: {memory[_PLAN]:g}." if turn else ""
        numbers = " ".join(f"{number:g}" for number in observation.reshape(-1).tolist())
        return f"Turn {turn + 1}.{last} You observe: {numbers}"

    def read(self, table: Any) -> tuple[_Answer, tuple[int, ...]]:
        answer = build(_ActionAnswer, table, "answer")
        checked("answer.action", answer.action, Annotated[int, Range(0, self._actions - 1)])
        return answer, (answer.action,)

    def act(self, plans: Int64, tensordict: TensorDictBase) -> Int64:
        at_random = self._script.choose(tensordict.get("observation")).numpy(force=True)
        return np.where(plans[..., 0] < 0, at_random, plans[..., 0])


class LanguageActor(TensorDictModuleBase):
    """S agents of every replica for which a language model makes plans.

    An agent asks where its plan has run out, while it is in play. Its plan, and what it remembers, are the
    entry "recurrent_state", which is zero where an episode begins.

    Args:
        spec: the model, and how often it is asked.
        playing: the game that the agents play, or its spaces if it is no `cprl.Game`.
        calls: makes the calls, and keeps them.
        seeds: the seed of each lane, lane = replica x S + agent.
        agents: the number of agents S of each replica.
        worlds: the number of worlds k of each replica, consecutive in the batch.
        said: what agents of all actors that play the same worlds said in this episode, turns and messages, by
            the world in the batch and the agent.
    """

    out_keys = ("action", recurrent_state.AFTER)

    def __init__(
        self,
        spec: Language,
        playing: Game | Spaces,
        *,
        calls: Calls,
        seeds: Sequence[Sequence[int]],
        agents: int,
        worlds: int = 1,
        said: dict[tuple[int, int], list[tuple[int, str]]] | None = None,
    ) -> None:
        super().__init__()
        self.spec = spec
        self.agents = agents
        self.worlds = worlds
        self.replicas = len(seeds) // agents
        size: dict[str, Any] = {"seeds": seeds, "agents": agents, "worlds": worlds}
        if isinstance(playing, Game):
            self.script: Any = ScriptedActor(Plan(spec.fallback), playing, **size)
            self._answers: Any = _BoardPlans(playing, self.script)
        else:
            self.script = scripted_lanes(spec.fallback, playing, **size)
            self._answers = _PlainActions(playing, self.script)
        self._system = "\n".join(filter(None, (spec.instructions, self._answers.rules(spec))))
        self._calls = calls
        self._seeds = seeds
        """Of each lane: the seed of the run, the replica, the agent, and the purpose, see `lane_seeds`."""
        self._said = {} if said is None else said
        self._asked = np.zeros((len(seeds), worlds), np.int64)
        """How often each lane has asked in each world."""
        self.state_cells = _PLAN + len(self._answers.fallback)
        self.in_keys = ("observation", recurrent_state.AFTER, keys.DONE, *self._answers.in_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict.get("observation")
        memory = tensordict.get(recurrent_state.AFTER).numpy(force=True).copy()
        for world, index in np.argwhere(memory[..., _TURN] == 0).tolist():
            self._said[world, self._seeds[index][2]] = []
        due = (memory[..., _NEXT] <= memory[..., _TURN]) & ~tensordict.get(keys.DONE).numpy(force=True)
        if isinstance(self._answers, _BoardPlans):
            memory[..., _HARVEST] += tensordict.get(keys.HARVEST[1]).numpy(force=True)
            due &= tensordict.get(keys.IN_PLAY[1]).numpy(force=True)
        if due.any():
            self._ask(observation.numpy(force=True), memory, np.argwhere(due))
            memory[due, _NEXT] = memory[due, _TURN] + self.spec.every_steps
        actions = self._answers.act(memory[..., _PLAN:].astype(np.int64), tensordict)
        memory[..., _TURN] += 1
        tensordict.set("action", torch.from_numpy(actions).to(observation.device))
        return tensordict.set(recurrent_state.AFTER, torch.from_numpy(memory).to(observation.device))

    def _ask(self, observation: AnyArray, memory: Float32, due: Int64) -> None:
        """Ask for the plans of some agents, [n, 2] by world and agent, and write them into the memory."""
        questions = [
            self._question(world, index, observation[world, index], memory[world, index])
            for world, index in due.tolist()
        ]
        answers = self._calls.ask(self.spec, questions, self._read)
        for (world, index), answer in zip(due.tolist(), answers, strict=True):
            plan, message = answer or (self._answers.fallback, "")
            memory[world, index, _PLAN:] = plan
            if message:
                self._said[world, self._seeds[index][2]].append((int(memory[world, index, _TURN]), message))

    def _read(self, table: Any) -> tuple[tuple[int, ...], str]:
        """Return the numbers of a plan, and a message; raise a ValueError if they are not allowed."""
        answer, plan = self._answers.read(table)
        if answer.message and not self._answers.talks:
            raise refusal("answer.message", answer.message, "none, in a game without talk")
        return plan, answer.message

    def _heard(self, world: int, listener: int, turn: float) -> list[str]:
        """Return the last message of each other agent before a turn, a line each; [] in a game without
        talk."""
        lines = [f"You are agent {listener}."] * self._answers.talks
        for (where, agent), messages in sorted(self._said.items()):
            earlier = [message for said_in, message in messages if said_in < turn]
            if where == world and agent != listener and earlier:
                lines.append(f"Agent {agent} says: {json.dumps(earlier[-1], ensure_ascii=False)}")
        return lines

    def _question(self, row: int, index: int, observation: AnyArray, memory: Float32) -> Question:
        """Return what an agent asks, by its row and index in the batch, and count it."""
        replica, world = divmod(row, self.worlds)
        lane = replica * self.agents + index
        number = int(self._asked[lane, world])
        self._asked[lane, world] += 1
        run_seed, replica_number, agent, *purpose = self._seeds[lane]
        call = (
            f"{Purpose(tuple(purpose)).name.lower()}, seed {run_seed}, replica {replica_number}, "
            f"world {world}, agent {agent}, call {number}"
        )
        seed = seed_of((*self._seeds[lane], world, number)) % _LARGEST_SEED
        heard = self._heard(row, agent, memory[_TURN])
        prompt = "\n".join([*heard, self._answers.seen(observation, memory)])
        return Question(call, seed, self._system, prompt)

    def get_extra_state(self) -> dict[str, Any]:
        return {"asked": torch.tensor(self._asked), "said": self._said}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._asked[:] = state["asked"].numpy(force=True)
        self._said.update(state["said"])
