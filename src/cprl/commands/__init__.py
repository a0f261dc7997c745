"""The command line: the only package that knows tyro.

Modules, in the order in which one reads them:
    main         the command cprl
    recipe       recipe_main: the command line of a recipe, the fields of an experiment as flags
    play_stored  cprl film, evaluate, visits, crossplay, schelling, egta, scenarios and exploit
    studies      cprl sweep, search and table; study_main: the command line of a recipe of a study
    recipes      cprl recipe, and recipes that cprl run takes by name
"""
