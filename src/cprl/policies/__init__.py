"""From observations to actions.

Modules, in the order in which one reads them:
    lanes           LaneActor: many agents at once, by the values or logits of their networks
    scripted        agents that follow a rule
    scripted_rules  these rules, compiled
    tabular         tables in which agents look actions up
    decisions       Decider: what agents decide at an episode's begin; Bandit: how they learn it
    assignment      AgentPolicies: which policy controls which agents
    present         PresentPolicy: the first replica's agents as they are now, beside the training
    rng             names and seeds of lanes, and random numbers of each lane's own
"""
