"""The task saracompare from images to measures: the same residuals, beams and regions for every imager; injected sources.

Measures and pictures themselves are in :mod:`casa_sara.analysis`.
"""
