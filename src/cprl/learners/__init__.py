"""How agents learn, many at once.

Modules, in the order in which one reads them:
    settings     the hyper-parameters, with their units and sources
    base         what the training loop asks of a learner
    checks       what learners refuse before they allocate anything
    transitions  the turns of some agents, as replay and rollouts store them
    lanes        a lane is one agent of one replica: seeds, networks, actors
    teams        the same where a lane is a team
    replay       ReplayLearner: learns from a replay buffer
    pace         when learners from replay update
    recurrent    what learners do for recurrent networks
    rollouts     RolloutLearner: learns from rollouts of the present policy
    advantages   the advantages of a rollout, by TorchRL's GAE
    lola/        LOLALearner: learns with the other members' learning in view
    decisions    Bandit: how agents learn what they decide at an episode's begin
    tabular      TabularLearner: Q-learning in tables
    single       the network and the loss of one DQN agent
    engine/      one update of all lanes: as a list of losses, vmapped, or with a lane axis; compiled
    buffer/      the storage and the sampler of the replay buffer of all lanes
    torchrl/     the same agents by stock TorchRL parts, one after the other
"""
