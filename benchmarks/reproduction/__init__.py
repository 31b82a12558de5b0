"""Reproduction of the paper, and beyond: ``python -m benchmarks.reproduction [PART ...]``.

``paper``: Table 1 and Figures 2 to 7 of Schierz, Arnold and Clauß (Modelica 2012), run again.
``beyond``: what this program does beyond the paper. Both write pages with pictures, in
``docs/reproduction/`` if nothing else is said.
"""
