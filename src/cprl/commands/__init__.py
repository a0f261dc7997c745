"""The command line: the only package that knows tyro.

Modules, in the order in which one reads them:
    main            the command cprl
    recipe          recipe_main: the command line of a recipe
    flags           the fields of an experiment as flags
    parts           what several commands do alike
    evaluation      cprl film, evaluate, visits, crossplay and schelling
    egta            cprl egta
    scenarios       cprl scenarios
    exploit         cprl exploit
    studies         cprl sweep and cprl table; study_main: the command line of a recipe of a study
    studies_options how a study is run, as options of a command line
    recipes         cprl recipe, and recipes that cprl run takes by name
    docs            cprl docs
"""
