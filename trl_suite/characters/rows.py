"""The planar characters as rows of data. Source: the character files of the original simulator."""

from __future__ import annotations

import dataclasses

from trl_suite.characters.character import CharacterRow, Joint

# The dog's pelvis box is rotated; the original measures these two limits against it (they act 0.61
# rad higher), but scales actions by the file's numbers.
_FILE_RANGE = (-1.57, 1.57)

# Joint(kp N m/rad, kd N m s/rad, reward weight, working posture rad), in link order; a prismatic
# joint has m for rad and N for N m.
_DOG_JOINTS = {
    'spine0': Joint(200, 20, 0.5, original_range=_FILE_RANGE),
    'spine1': Joint(200, 20, 0.5),
    'spine2': Joint(200, 20, 0.5),
    'spine3': Joint(200, 20, 0.5),
    'torso': Joint(200, 20, 1),
    'neck0': Joint(50, 5, 0.2, 0.68507),
    'neck1': Joint(50, 5, 0.2, 0.2),
    'head': Joint(50, 5, 0.2, 0.20456),
    'tail0': Joint(4, 0.4, 0.001, 0.4),
    'tail1': Joint(4, 0.4, 0.001, 0.2),
    'tail2': Joint(4, 0.4, 0.001, 0.2),
    'tail3': Joint(4, 0.4, 0.001, 0.2),
    'shoulder': Joint(160, 16, 1, -0.5224),
    'elbow': Joint(80, 8, 1, 0.87117),
    'wrist': Joint(80, 8, 1, 0.11488),
    'finger': Joint(80, 8, 1, -0.46365),
    'hip': Joint(130, 13, 1, 0.61719, original_range=_FILE_RANGE),
    'knee': Joint(50, 5, 1, -1.31193),
    'ankle': Joint(50, 5, 1, 1.32022),
    'toe': Joint(50, 5, 1, -0.62549),
}

_RAPTOR_JOINTS = {
    'spine0': Joint(200, 20, 0.5, 0.16682),
    'spine1': Joint(200, 20, 0.5, 0.03457),
    'spine2': Joint(100, 10, 0.5, 0.11743),
    'spine3': Joint(100, 10, 0.5, 0.11914),
    'head': Joint(100, 10, 0.5, 0.75355),
    'tail0': Joint(100, 10, 0.25, 0.09288),
    'tail1': Joint(50, 5, 0.25, 0.04206),
    'tail2': Joint(50, 5, 0.25, 0.12818),
    'tail3': Joint(50, 5, 0.25, 0.01178),
    'tail4': Joint(50, 5, 0.25, 0.24638),
    'right_hip': Joint(300, 30, 1, 0.46487),
    'right_knee': Joint(300, 30, 0.5, -1.456),
    'right_ankle': Joint(250, 25, 0.5, 1.37779),
    'right_toe': Joint(100, 10, 0.5, -0.3883),
    'left_hip': Joint(300, 30, 1, 0.46487),
    'left_knee': Joint(300, 30, 0.5, -1.456),
    'left_ankle': Joint(250, 25, 0.5, 1.37779),
    'left_toe': Joint(100, 10, 0.5, -0.3883),
}

_BIPED2D_JOINTS = {
    'right_hip': Joint(300, 30, 0.3),
    'right_knee': Joint(300, 30, 0.3),
    'right_ankle': Joint(100, 10, 0.2),
    'left_hip': Joint(300, 30, 0.3),
    'left_knee': Joint(300, 30, 0.3),
    'left_ankle': Joint(100, 10, 0.2),
}

_BIPED2D_SIMBICON_JOINTS = {
    'right_hip': Joint(200, 20, 0.3),
    'right_knee': Joint(200, 20, 0.3),
    'right_ankle': Joint(150, 15, 0.2),
    'left_hip': Joint(200, 20, 0.3),
    'left_knee': Joint(200, 20, 0.3),
    'left_ankle': Joint(150, 15, 0.2),
}

_BIPED2D_FULL_JOINTS = {
    'right_hip': Joint(200, 20, 0.3),
    'right_knee': Joint(200, 20, 0.3),
    'right_ankle': Joint(100, 10, 0.2),
    'left_hip': Joint(200, 20, 0.3),
    'left_knee': Joint(200, 20, 0.3),
    'left_ankle': Joint(100, 10, 0.2),
    'right_shoulder': Joint(150, 15, 0.3),
    'right_forearm': Joint(100, 10, 0.3),
    'left_shoulder': Joint(150, 15, 0.3),
    'left_forearm': Joint(100, 10, 0.3),
    'neck': Joint(100, 10, 0.3),
}

# The original calls these two spine0 and spine1. The leg is prismatic.
_HOPPER_JOINTS = {
    'hip': Joint(200, 20, 0.5),
    'leg': Joint(1000, 20, 0.5),
}

DOG = CharacterRow(
    name='dog',
    joints=_DOG_JOINTS,
    fall_links=(
        'root', 'spine0', 'spine1', 'spine2', 'spine3', 'torso', 'neck0', 'neck1', 'head',
    ),
    end_effectors=('finger', 'toe'),
    stumble_exempt=('toe', 'finger', 'ankle', 'wrist'),
    description='Dog, 21 links: a segmented spine, a tail, one simulated front and hind leg.',
)  # fmt: skip

_GOAT_JOINTS = {name: dataclasses.replace(joint, weight=1.0) for name, joint in _DOG_JOINTS.items()}
_GOAT_JOINTS['neck0'] = dataclasses.replace(_GOAT_JOINTS['neck0'], target=0.40041)

GOAT = CharacterRow(
    name='goat',
    joints=_GOAT_JOINTS,
    fall_links=('root', 'spine0'),
    end_effectors=('finger', 'toe'),
    stumble_exempt=('toe', 'finger', 'ankle', 'wrist'),
    description='Goat, 21 links: the skeleton of the dog with horns; only its rump is a fall.',
)

RAPTOR = CharacterRow(
    name='raptor',
    joints=_RAPTOR_JOINTS,
    fall_links=('root', 'spine0', 'spine1', 'spine2', 'spine3', 'head'),
    end_effectors=('right_toe', 'left_toe'),
    stumble_exempt=('right_toe', 'left_toe', 'right_ankle', 'left_ankle'),
    description='Raptor, 19 links: a heavy pelvis between a neck, a tail and two bird legs.',
)

BIPED2D = CharacterRow(
    name='biped2d',
    joints=_BIPED2D_JOINTS,
    fall_links=('root',),
    end_effectors=('right_ankle', 'left_ankle'),
    stumble_exempt=('right_ankle', 'left_ankle'),
    description='Biped, 7 links: a trunk of 25 kg and two legs; the feet are the ankle links.',
)

BIPED2D_SIMBICON = CharacterRow(
    name='biped2d_simbicon',
    joints=_BIPED2D_SIMBICON_JOINTS,
    fall_links=('root',),
    end_effectors=('right_ankle', 'left_ankle'),
    stumble_exempt=('right_ankle', 'left_ankle', 'right_knee', 'left_knee'),
    description='Biped of the gait state machines, 7 links: the biped with heavier legs.',
)

BIPED2D_FULL = CharacterRow(
    name='biped2d_full',
    joints=_BIPED2D_FULL_JOINTS,
    fall_links=(
        'root', 'right_hip', 'left_hip', 'right_shoulder', 'right_forearm', 'left_shoulder',
        'left_forearm', 'neck',
    ),
    end_effectors=('right_ankle', 'left_ankle'),
    stumble_exempt=('right_ankle', 'left_ankle'),
    description='Biped with arms and head, 12 links, with human torque limits.',
)  # fmt: skip

HOPPER = CharacterRow(
    name='hopper',
    joints=_HOPPER_JOINTS,
    fall_links=('root',),
    end_effectors=('leg',),  # none in the original's file; the foot is the lower end of the leg
    stumble_exempt=('leg',),
    description='Hopper, 3 links: a body on one leg, which slides along the thigh.',
)

CHARACTERS: dict[str, CharacterRow] = {
    row.name: row for row in (DOG, GOAT, RAPTOR, BIPED2D, BIPED2D_SIMBICON, BIPED2D_FULL, HOPPER)
}
