"""driftlab: inertial units at rest, their thermal bias, and the filters that track it.

The application is the only place where angular rate omega, specific force f and temperature T have a meaning
together. Conventions: SI, temperatures in degC; body axes x, y, z as in the recording, right-handed where a heading
is used; the local level frame is east, north, up.
"""

from importlib.metadata import version

__version__ = version("driftlab")
