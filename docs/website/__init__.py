"""How `make docs` makes the site out of the pages.

Modules, in the order in which one reads them:
    build        the command: a folder of Markdown is staged, and MkDocs builds it
    pages        the pages, and what they link to elsewhere in the repository
    navigation   the order of the pages, which docs/index.md lists
    reference    the reference: packages by their docstrings, commands by their --help
    replays      the recordings of docs/results, and the page that plays them

MkDocs with Material, whose makers mend it until May 2027, sees a plain folder of Markdown and mkdocs.yml, and
no hooks, so that its successor Zensical, 0.1 when this was written, can take its place.
"""
