"""The Rerun recording of a training.

Modules, in the order in which one reads them:
    callback   ViewerCallback: logs a training while it runs
    recorder   which episodes are recorded frame by frame
    frames     frames of one world, collected in memory
    events     new bests and phases, in words
    logger     RerunLogger: TorchRL's logger interface on a recording
    exhibition a world that the present policy plays, for viewers alone
    streams    to a file, and served live
    sending    one stream, which may fail without harm
    page       the web viewer's page on 127.0.0.1, and recordings for it
    deadline   calls that may wait for a viewer, with deadlines
    scenery    names and colours of what a recording shows
    stage      frames as Rerun's columns
    blueprint  the layout of the viewer
"""
