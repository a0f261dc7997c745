"""What a replay buffer of many lanes is made of."""
