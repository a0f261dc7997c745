"""Neural networks of agents: they map observations to action values, logits or state values.

Modules, in the order in which one reads them:
    mlp            MLP: fully connected layers
    convolutional  Conv: convolutions over rows and columns
    recurrent      GRU, LSTM: a state that is kept from turn to turn
    specification  Network: which of them an algorithm has; networks of your own
    agent          several networks of one agent, values of joint actions
    team           the networks of a team
    stacked        the networks of many lanes as one
    finite         whether weights are numbers
"""

from cprl.networks.agent import AgentNetworks
from cprl.networks.convolutional import Conv, ConvNetwork
from cprl.networks.mlp import MLP, MLPNetwork
from cprl.networks.recurrent import GRU, LSTM
from cprl.networks.specification import Network

__all__ = ["GRU", "LSTM", "MLP", "AgentNetworks", "Conv", "ConvNetwork", "MLPNetwork", "Network"]
