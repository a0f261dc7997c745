"""Runs of agents whose plans a language model makes; as a process, one that can be killed."""

import os
import sys
from dataclasses import replace

import cprl
from cprl import Experiment, Game, Rules, maps
from cprl.population import Language
from cprl.runs.checkpoints import Checkpointer

BOARD = ".A>.A\n.A.A.\n..<.A\n>.A.<"
RULES = Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=25, freeze_steps=2)
GAME = Game(map=maps.parse(BOARD), rules=RULES)
TALK = replace(GAME, rules=replace(RULES, signals=1))


def language(url="http://127.0.0.1:9", **fields):
    return Language(
        **{"model": "small", "base_url": url, "every_steps": 10, "retries": 0, "backoff_s": 0.0, **fields}
    )


def experiment(spec, **fields):
    parts = {"name": "talk", "game": GAME, "agents": (spec,) * 4, "episodes": 4, "replicas": 2, "seed": 3}
    return Experiment(**{**parts, "evaluation_episodes": 2, "engine": "eager", **fields})


def run_language(spec, out, **options):
    return cprl.run(experiment(spec), out, watch="off", figures=False, **options)


def offline(run, spec):
    return replace(spec, base_url="http://127.0.0.1:9", stored=os.path.relpath(run))


if __name__ == "__main__":
    url, out = sys.argv[1:]
    Checkpointer.__init__.__kwdefaults__["every_s"] = 0.01
    run_language(language(url), out)
