"""From seeing to doing: networks, actors that learn or that follow a script, and the seats that they take."""

from cprl.acting.actors import QActor, RandomActor
from cprl.acting.lanes import LaneActor, LaneQNetwork, random_lanes, random_seats
from cprl.acting.networks import QNetwork
from cprl.acting.scripted import ScriptedActor
from cprl.acting.seats import Seats

__all__ = [
    "LaneActor",
    "LaneQNetwork",
    "QActor",
    "QNetwork",
    "RandomActor",
    "ScriptedActor",
    "Seats",
    "random_lanes",
    "random_seats",
]
