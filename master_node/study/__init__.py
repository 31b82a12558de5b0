"""Studies: a matrix of whole co-simulations, each a process of its own, and one table of results.

``configuration.py`` reads a study, ``plan.py`` makes runs of it and checks them, ``execution.py``
lets a `Runner` execute them, ``table.py`` gathers what came out. ``docs/sweep.md`` explains it.
"""
