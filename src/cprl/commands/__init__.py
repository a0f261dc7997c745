"""The command line: the only package that knows tyro.

Modules, in the order in which one reads them:
    main         the command cprl: run, recipe, watch, export, and where the other commands are
    recipe       recipe_main: the command line of a recipe
    flags        the fields of an experiment as flags
    play_stored  cprl film, play, evaluate, visits, crossplay, schelling, egta, scenarios and exploit
    studies      cprl sweep and search; study_main: the command line of a recipe of a study
    table        cprl table
"""
