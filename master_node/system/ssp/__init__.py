"""System Structure and Parameterization (SSP): packages read into systems, systems written out.

``xml_nodes`` parses, ``parameters`` and ``reading`` say what a document holds (``structure``),
``flattening`` makes slaves and connections of it, ``writing`` goes the other way.
"""
