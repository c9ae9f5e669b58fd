"""Converts a motion file to a clip, checks it, and runs a character with it.

    python examples/own_clip.py walk.bvh --character biped2d_full --strip walk.png
    python examples/own_clip.py 02_01.amc --skeleton 02.asf --character biped3d_full_mocap

Reads BVH, CMU's AMC, and the JSON of TerrainRL and DeepMimic. For other joint names, pass a map to
`retarget`. BVH needs `pip install 'trl_suite[clips,video]'`.
"""

import argparse

from trl_suite import rendering, retargeting, suite
from trl_suite.retargeting import clip_check
from trl_suite.util.program import begin_script


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('file')
    parser.add_argument('--skeleton', help='the .asf of an .amc')
    parser.add_argument('--character', default='biped2d_full')
    parser.add_argument('--strip', help='a .png: open-loop tracking, with the clip as a ghost')
    chosen = parser.parse_args(arguments)

    motion = retargeting.read(chosen.file, chosen.character, chosen.skeleton)
    clip = retargeting.retarget(motion, chosen.character)
    if not clip.loop:
        clip = retargeting.cycle(clip)  # between the two most similar poses
    print(clip_check.check(clip, chosen.character))
    clip.save('clip.npz')

    environment = suite.build(chosen.character, clip=clip, task_kwargs={'random': 1})
    if chosen.strip:
        frames = rendering.frames(
            environment, lambda _: environment.task.clip_action(0), 30, ghost=True
        )
        rendering.film_strip(frames, chosen.strip)


if __name__ == '__main__':
    begin_script()
    main()
