"""Generated inputs for everything of cprl that is public: `python -m tests.fuzz`, or `make fuzz`.

Modules, in the order in which one reads them:
    public    what is public, found mechanically
    hostile   values that fit nowhere
    things    valid values and live objects: games, environments, networks, runs
    hints     strategies out of type hints
    cases     one call: its arguments, and how they are drawn
    drawn     how the arguments of some public names are drawn
    calling   how some are called
    damage    what can become of a file
    formats   the files of a run, damaged, and who reads them
    commands  command lines
    register  a target for each public name
    runner    runs the cases of a target and says how each ended
    workers   processes that may die of a case
    table     the table of outcomes
"""
