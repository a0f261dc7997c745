"""Neural networks of agents: they map observations to action values, logits or state values.

Modules, in the order in which one reads them:
    mlp            MLP: fully connected layers
    convolutional  Conv: convolutions over rows and columns, then fully connected layers
    recurrent      GRU, LSTM: networks with a state that lasts from turn to turn
    specification  Network: the network that an algorithm names, and how it is made; networks of your own
    agent          AgentNetworks: the networks of one agent; JointNetwork: values of joint actions
    team           the networks of a team's members as one, central critics, mixing networks
    stacked        the networks of many lanes as one, computed together
    finite         find NaN and infinite numbers in weights
"""

from cprl.networks.agent import AgentNetworks
from cprl.networks.convolutional import Conv, ConvNetwork
from cprl.networks.mlp import MLP, MLPNetwork
from cprl.networks.recurrent import GRU, LSTM
from cprl.networks.specification import Network

__all__ = ["GRU", "LSTM", "MLP", "AgentNetworks", "Conv", "ConvNetwork", "MLPNetwork", "Network"]
