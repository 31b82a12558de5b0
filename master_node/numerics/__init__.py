"""The numerical method of Schierz, Arnold and Clauß (Modelica 2012): arrays in, arrays out.

``extrapolation``: input polynomials from past communication points. ``error_estimators``: EST_Rich
and EST_mod. ``norms``: ERR, equation (8). ``step_size_controller``: accept or reject, next H.
No I/O, no clock, no bus: everything here runs in a REPL with arrays alone.
"""
