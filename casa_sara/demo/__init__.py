"""The demo: tsara and tclean, on a simulated radio galaxy and on the VLA observation of 3C273 that comes with CASA.

Run ``python -m casa_sara.demo``.
"""
