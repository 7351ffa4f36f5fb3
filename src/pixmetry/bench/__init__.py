"""A page on loopback to move what a camera is and to see what it does to a target; and to look at results.

Enters: a camera and a scenario, or files of results. Leaves: a server for one user, which computes with the functions of the other rooms,
and writes nothing.
"""
