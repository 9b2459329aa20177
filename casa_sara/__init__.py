"""SARA imaging for CASA: ``from casa_sara import tsara``.

Importing this package needs no CASA and takes milliseconds; a task imports CASA when it is called.
"""

from casa_sara.tasks import *
from casa_sara.version import __version__
