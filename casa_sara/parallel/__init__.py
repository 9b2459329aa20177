"""The communicator of one process or of the ranks of an MPI job, and the division of the work among the ranks.

What is computed is known elsewhere.
"""
