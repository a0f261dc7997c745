"""How agents learn, many at once.

To see the whole of learning in plain code, begin with `plain`; the other modules do the same for all agents
together.

Modules, in the order in which one reads them:
    plain          learning by TorchRL's stock parts, one agent after the other, and a whole training loop
    settings       the hyperparameters, with their units and sources
    learner        Learner: the agents that learn by one algorithm, with their memory and networks
    lanes          Lanes: the agents or teams that learn independently of each other
    transitions    the turns of some agents, as memories store them
    draw           Draw: a batch to learn from that is gathered inside the compiled update
    ring           Ring: the replay buffer of all lanes
    replay         Replay: the memory of off-policy agents, which learn from the latest turns in any order
    rollouts       Rollouts: the memory of on-policy agents, which learn from turns of their current policy
    networks       LaneNetworks: the networks of all lanes, which act and learn
    optimizers     optimisers, for the weights of all lanes at once
    choose_update  choose whether the lanes of a user's loss are updated together or one after the other
    loss_state     find what a loss keeps from one call to the next
    refusals       refuse losses and networks that do not fit the memory or the settings
    lola           the memory and networks of teams whose members anticipate how the others learn
    tabular        the memory and the tables of agents that learn by Q-learning in tables
"""
