"""What is kept of a run: files alone.

Modules, in the order in which one reads them:
    files        files that are never left half written, their formats and checksums; one process writes a run
    length       how long a training is: episodes or steps
    schedule     how long it is, in how many worlds, and when its agents learn
    recipe       the run's directory and recipe.json
    journal      rows that are safe as soon as they are written
    episodes     the table of episodes, and its journal
    curves       tables as curves over episodes
    checkpoints  the state of a training, to resume from, or to extend
    weights      trained networks, the state of transforms, the values of decisions
    states       the state of a run's directory, and the step that follows: start, resume or extend
    played       a run of people, finished without a training
    loggers      TorchRL's loggers: TensorBoard, W&B
    export       a finished run, small enough to commit
"""
