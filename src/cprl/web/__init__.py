"""Pages for a browser: episodes, reports, the explorable and the sandbox, games that people play.

Modules, in the order in which one reads them:
    scenes          a board as JSON, for the one renderer, static/board.js
    static_pages    a page of one file, put together from those of static/
    show            episodes side by side on a page, which opens from the disk without a network
    report          a page about a run or a study: its results, with intervals, and how to run it again
    playable        a game as JSON, for static/game.js, which plays it exactly
    explorable      the page of five steps, in which scripted agents play without a server
    messages        the protocol between a hosted game and whoever takes a seat in it
    hosting         how a hosted game goes, as the flags of cprl host
    session         a hosted game as a value: its rounds under treatments, its agents
    hosted_round    the worlds of one round, and what is kept of it: turns, chat, a run
    hall            the people of a session, its stages and its clock, without a network
    serving         who may ask a server of pages, and how long; for hosted games and the sandbox
    host            the server of a hosted game
    sandbox         the same page with what needs Python: own boards and rules, trainings, recipes
"""
