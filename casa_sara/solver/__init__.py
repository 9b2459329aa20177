"""The mathematics of Algorithms 1 and 2: the adaptive primal-dual iteration, bounds, re-weighting, the support.

Operators and communicator are passed in; data and files are known elsewhere.
"""
