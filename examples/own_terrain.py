"""A terrain from an image or a mesh, with a walker. Needs `pip install 'trl_suite[video,policies]'`."""

import argparse
import pathlib

import imageio.v3 as imageio
import numpy as np

from trl_suite import rendering, suite, terrain
from trl_suite.util.program import begin_script

begin_script()
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument('file', nargs='?', type=pathlib.Path)
parser.add_argument('--spacing', type=float, default=0.2, help='distance of pixels or points, m')
parser.add_argument('--height', type=float, default=1.5, help='height of white pixels, m')
parser.add_argument('--seed', type=int, default=1)
parser.add_argument('--output', type=pathlib.Path, default='own_terrain.png')
args = parser.parse_args()
if args.file is None:
    args.file = args.output.with_name('crater.png')
    x, y = np.meshgrid(*[np.linspace(-12, 12, 121)] * 2)
    grey = np.exp(-((np.hypot(x, y) - 6) ** 2)) * (0.8 + 0.2 * np.cos(5 * np.arctan2(y, x)))
    imageio.imwrite(args.file, (65535 * grey).astype(np.uint16))
if args.file.suffix == '.png':
    mine = terrain.from_image(args.file, args.spacing, high=args.height)
else:
    mine = terrain.from_mesh(args.file, args.spacing, centre=True)
ground = terrain.SpatialGround(mine, args.seed)
terrain.save_mesh(ground, args.output.with_suffix('.glb'), low=-12, high=12)
print(f'{ground.height(0, 0):.2f} m at the origin, {ground.height(6, 0):.2f} m 6 m ahead')
env = suite.build('biped3d_mocap', None, mine, 'footsteps', task_kwargs={'random': args.seed})
policy = suite.reference_policy('PD_Biped3D_LLC_General_Step-v0')  # does not observe the ground
time_step, frames = env.reset(), []
for step in range(121):
    if step % 40 == 0:
        frames.append(rendering.frame(env, 240, 320, 'back'))
    time_step = env.step(policy(time_step.observation))
rendering.film_strip(frames, args.output)
