"""From seeing to doing: networks, actors for one agent, and the seats that they take in a game."""

from cprl.acting.actors import QActor, RandomActor
from cprl.acting.networks import QNetwork
from cprl.acting.seats import Seats

__all__ = ["QActor", "QNetwork", "RandomActor", "Seats"]
