"""The task saracompare: the same residuals, beams, regions and measures for every imager; injected sources.

Measures and pictures themselves are in :mod:`casa_sara.analysis`.
"""
