"""The command line; the only package that knows tyro.

Modules, in the order in which one reads them:
    main            the command cprl: run, recipe, watch, export, and where the other commands are
    recipe_command  recipe_main: the command line of a recipe
    flags           the fields of an experiment as flags
    play_stored     cprl film, show, report, play, evaluate, crossplay and scenarios
    play_by_keys    an episode in the terminal, for cprl play
    studies         cprl sweep; study_main: the command line of a recipe of a study
    table_command   cprl table
    host_command    cprl host
    sandbox_command  cprl sandbox
    experimental_commands  cprl egta, exploit, schelling, search and visits, which may change
"""
