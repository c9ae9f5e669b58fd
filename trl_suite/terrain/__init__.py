"""Random planar terrain in plain NumPy: parameter files, generators, and the endless strip.

from trl_suite import terrain

ground = terrain.Strip(terrain.load('slopes_mixed'), seed=1)  # a preset, a file or a mapping
ground.height([-0.5, 12.3])  # m; the ground is drawn as far as it is asked for
heights, vertical = ground.window(-40, 800)  # vertices SPACING apart, from x = -1 m on

mine = terrain.load({'Type': 'var2d_gaps', 'Params': [{'GapWMin': 0.2, 'GapWMax': 0.4}]})
mine.parameters()  # with the defaults of all that was not given
sorted(terrain.PRESETS), sorted(terrain.GENERATORS)  # what there is; `register` adds a type
"""

from trl_suite.terrain.generators import GENERATORS, SPACING, Profile, register
from trl_suite.terrain.parameters import PRESETS, Terrain, load
from trl_suite.terrain.strip import Strip

__all__ = ['GENERATORS', 'PRESETS', 'SPACING', 'Profile', 'Strip', 'Terrain', 'load', 'register']
