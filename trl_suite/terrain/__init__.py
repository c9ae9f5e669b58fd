"""Random terrain in plain NumPy: parameter files, generators, planar and 3D ground.

from trl_suite import terrain

ground = terrain.PlanarGround(terrain.load('slopes_mixed'), seed=1)  # a preset, a file or a mapping
ground.height([-0.5, 12.3])  # m; ground is generated where it is queried
heights, vertical = ground.window(-40, 800)  # vertices SPACING apart, starting at x = -1 m

mine = terrain.load({'Type': 'var2d_gaps', 'Params': [{'GapWMin': 0.2, 'GapWMax': 0.4}]})
mine.parameters()  # with defaults for parameters that were not given
sorted(terrain.PRESETS), sorted(terrain.GENERATORS)  # names; `register` adds a type

forest = terrain.SpatialGround(terrain.load('pillars3d'), seed=1)  # three-dimensional
x, y, heading = forest.spawn(np.random.default_rng(1))
forest.height(x, y), forest.goal(np.random.default_rng(2), root=(x, y))
sorted(terrain.PRESETS3D), sorted(terrain.GENERATORS3D)  # `register3d` adds a type

around = terrain.Surroundings(1, terrain.capacity(terrain.load('pillars3d')))  # for n characters
around.begin(0, forest, (x, y))
around.height(np.array([[x, x + 1]]), np.array([[y, y]]))  # (1, 2)

terrain.from_mesh('canyon.glb')  # also from_image, from_heights, from_function
terrain.save_mesh(forest, 'forest.obj', low=-20, high=20)
"""

from trl_suite.terrain.custom import from_function, from_heights, from_image, from_mesh
from trl_suite.terrain.generators import (
    GENERATORS,
    GENERATORS3D,
    SPACING,
    Parameter,
    Profile,
    register,
    register3d,
)
from trl_suite.terrain.mesh import WRITTEN, save_mesh, to_mesh
from trl_suite.terrain.parameters import PRESETS, PRESETS3D, Terrain, load
from trl_suite.terrain.planar.ground import PlanarGround
from trl_suite.terrain.spatial.features import IDLE
from trl_suite.terrain.spatial.ground import SpatialGround
from trl_suite.terrain.spatial.layout import GRID, Belts, Boxes, Layout, Movers, boxes
from trl_suite.terrain.spatial.surroundings import Surroundings, capacity

__all__ = [
    'GENERATORS',
    'GENERATORS3D',
    'GRID',
    'IDLE',
    'PRESETS',
    'PRESETS3D',
    'SPACING',
    'WRITTEN',
    'Belts',
    'Boxes',
    'Layout',
    'Movers',
    'Parameter',
    'PlanarGround',
    'Profile',
    'SpatialGround',
    'Surroundings',
    'Terrain',
    'boxes',
    'capacity',
    'from_function',
    'from_heights',
    'from_image',
    'from_mesh',
    'load',
    'register',
    'register3d',
    'save_mesh',
    'to_mesh',
]
