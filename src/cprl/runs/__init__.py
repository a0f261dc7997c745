"""What is kept of a run: files alone.

Modules, in the order in which one reads them:
    directory    the run's directory and recipe.json
    formats      the numbers of the formats of files; newer ones are refused
    recipes      the experiment of a recipe
    source       from which commit the code of cprl is
    files        files that are never left half written
    lock         at most one process writes a run
    manifest     checksums of results
    journal      rows that are safe as soon as they are written
    columns      episodes as rows
    episodes     the table of episodes
    labelled     several tables as one
    curves       tables as curves over episodes
    checkpoints  the state of a training, to resume from
    extension    more episodes for a run that is finished or stopped
    weights      trained networks, the state of transforms, the values of decisions
    kept         what a run keeps of its agents, ended or not
    loggers      TorchRL's loggers: TensorBoard, W&B
    export       a finished run, small enough to commit
"""
