"""Users' own motions for a character: reading, retargeting, cutting to a cycle, and checks.

from trl_suite import retargeting, suite

motion = retargeting.read('walk.bvh', 'biped2d_full')
clip = retargeting.cycle(retargeting.retarget(motion, 'biped2d_full'))
environment = suite.build('biped2d_full', clip=clip)
"""

from trl_suite.retargeting.cycles import cycle
from trl_suite.retargeting.reading import FORMATS, read
from trl_suite.retargeting.transfer import NAMES, counterparts, guess_map, retarget

__all__ = ['FORMATS', 'NAMES', 'counterparts', 'cycle', 'guess_map', 'read', 'retarget']
