"""On import, makes GalSim's sensor type Silicon build a :class:`bfsensor.SiliconSensor`.

With ``modules: [bfsensor.as_silicon]`` a configuration that says ``type: Silicon``, such as
imSim's, needs no other change.
"""

from bfsensor.galsim import register

register(silicon=True)
