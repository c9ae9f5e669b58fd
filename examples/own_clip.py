"""Makes a motion of yours into a clip, says what is wrong with it, and lets a character track it.

    python examples/own_clip.py walk.bvh --character biped2d_full --strip walk.png
    python examples/own_clip.py 02_01.amc --skeleton 02.asf --character biped3d_full_mocap

Reads BVH, CMU's AMC, and the JSON of TerrainRL and DeepMimic. Where joints have unusual names, give
`retarget` a map. BVH needs `pip install 'trl_suite[clips,video]'`.
"""

import argparse

from trl_suite import rendering, retargeting, suite
from trl_suite.retargeting import clip_check


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('file')
    parser.add_argument('--skeleton', help='the .asf of an .amc')
    parser.add_argument('--character', default='biped2d_full')
    parser.add_argument('--strip', help='a .png: following the clip blindly, clip as a ghost')
    chosen = parser.parse_args(arguments)

    motion = retargeting.read(chosen.file, chosen.character, chosen.skeleton)
    clip = retargeting.retarget(motion, chosen.character)
    if not clip.loop:
        clip = retargeting.cycle(clip)  # the two moments that are most alike
    print(clip_check.check(clip, chosen.character))
    clip.save('clip.npz')

    environment = suite.build(chosen.character, clip=clip, task_kwargs={'random': 1})
    frames = rendering.frames(
        environment, lambda _: environment.task.clip_action(0), 30, ghost=True
    )
    if chosen.strip:
        rendering.film_strip(frames, chosen.strip)


if __name__ == '__main__':
    main()
