"""A person plays among trained or scripted agents.

Modules, in the order in which one reads them:
    session   Session: the turns of an episode, without any input or output
    opening   which board, and who the others are
    keys      the keys and the actions they stand for
    wording   what a person who plays reads
    terminal  in the terminal, by lines of keys
"""
