"""The characters as data. Source: the character files of the original simulator."""

from __future__ import annotations

import dataclasses

from trl_suite.characters.character import CharacterSpec, Joint

# The dog's pelvis box is rotated; the original measures these two limits relative to it (so they
# are effectively 0.61 rad higher), but scales actions by the numbers in the file.
_FILE_RANGE = (-1.57, 1.57)


def _joints(kp: float, weight: float, **targets: float) -> dict[str, Joint]:
    """Returns joints that differ in name and working posture; kd is a tenth of kp."""
    return {name: Joint(kp, kp / 10, weight, target) for name, target in targets.items()}


def _sides(**joints: Joint) -> dict[str, Joint]:
    """Returns the joints of both sides of a body, those of the right side first."""
    return {f'{side}_{name}': joint for side in ('right', 'left') for name, joint in joints.items()}


# Joint(kp N m/rad, kd N m s/rad, reward weight, working posture rad), in link order; for a
# prismatic joint read m for rad and N for N m. The MJCF files define which joints are spherical.
_DOG_JOINTS = {
    'spine0': Joint(200, 20, 0.5, original_range=_FILE_RANGE),
    **_joints(200, 0.5, spine1=0, spine2=0, spine3=0),
    **_joints(200, 1, torso=0),
    **_joints(50, 0.2, neck0=0.68507, neck1=0.2, head=0.20456),
    **_joints(4, 0.001, tail0=0.4, tail1=0.2, tail2=0.2, tail3=0.2),
    **_joints(160, 1, shoulder=-0.5224),
    **_joints(80, 1, elbow=0.87117, wrist=0.11488, finger=-0.46365),
    'hip': Joint(130, 13, 1, 0.61719, original_range=_FILE_RANGE),
    **_joints(50, 1, knee=-1.31193, ankle=1.32022, toe=-0.62549),
}

_RAPTOR_JOINTS = {
    **_joints(200, 0.5, spine0=0.16682, spine1=0.03457),
    **_joints(100, 0.5, spine2=0.11743, spine3=0.11914, head=0.75355),
    **_joints(100, 0.25, tail0=0.09288),
    **_joints(50, 0.25, tail1=0.04206, tail2=0.12818, tail3=0.01178, tail4=0.24638),
    **_sides(
        hip=Joint(300, 30, 1, 0.46487),
        knee=Joint(300, 30, 0.5, -1.456),
        ankle=Joint(250, 25, 0.5, 1.37779),
        toe=Joint(100, 10, 0.5, -0.3883),
    ),
}

_BIPED2D_JOINTS = _sides(
    hip=Joint(300, 30, 0.3), knee=Joint(300, 30, 0.3), ankle=Joint(100, 10, 0.2)
)
_BIPED2D_SIMBICON_JOINTS = _sides(
    hip=Joint(200, 20, 0.3), knee=Joint(200, 20, 0.3), ankle=Joint(150, 15, 0.2)
)
_ARMS = _sides(shoulder=Joint(150, 15, 0.3), forearm=Joint(100, 10, 0.3))
_BIPED2D_FULL_JOINTS = {
    **_sides(hip=Joint(200, 20, 0.3), knee=Joint(200, 20, 0.3), ankle=Joint(100, 10, 0.2)),
    **_ARMS,
    'neck': Joint(100, 10, 0.3),
}

# The original calls these two spine0 and spine1. The leg is prismatic.
_HOPPER_JOINTS = {'hip': Joint(200, 20, 0.5), 'leg': Joint(1000, 20, 0.5)}

_BIPED3D_JOINTS = {
    'torso': Joint(1000, 100, 0.5),
    **_sides(hip=Joint(300, 30, 0.5), knee=Joint(300, 30, 0.3), ankle=Joint(100, 10, 0.2)),
}
# Five times the gain with half the foot: with an armature of 0.01 an ankle at its torque limit may
# oscillate.
_BIPED3D_MOCAP_RUN_JOINTS = {
    'torso': Joint(1000, 100, 0.5),
    **_sides(
        hip=Joint(500, 50, 0.5),
        knee=Joint(500, 50, 0.3),
        ankle=Joint(500, 50, 0.2, armature=0.03),
    ),
}
# The original's spelling is sholder. Arms and head move by a hundredth of a radian.
_RIGID = Joint(100, 10, 0.001)
_BIPED3D_FULL_MOCAP_JOINTS = {
    **_BIPED3D_JOINTS,
    **_sides(shoulder=_RIGID, elbow=_RIGID, wrist=_RIGID),
    'neck': _RIGID,
    'head': _RIGID,
}
# The only spherical joints whose limits are not symmetric.
_BIPED3D_SIMBICON_JOINTS = _sides(
    hip=Joint(200, 20, 0.3, original_range=(-0.7, 1.4)),
    knee=Joint(200, 20, 0.3),
    ankle=Joint(100, 10, 0.2, original_range=(-1, 0.57)),
)

_SPINE = ('spine0', 'spine1', 'spine2', 'spine3')
_TO_PARENT = ('targets of hips and shoulders are angles to the parent link, not to the world',)
_BORROWED = ('the original has no muscles for this character; those of another character are used',)

DOG = CharacterSpec(
    name='dog',
    joints=_DOG_JOINTS,
    fall_links=('root', *_SPINE, 'torso', 'neck0', 'neck1', 'head'),
    end_effectors=('finger', 'toe'),
    stumble_exempt=('toe', 'finger', 'ankle', 'wrist'),
    description='Dog, 21 links: a segmented spine, a tail, one simulated front and hind leg.',
    clip='dog_bound',
    differences={'position': _TO_PARENT},
)

_GOAT_JOINTS = {name: dataclasses.replace(joint, weight=1.0) for name, joint in _DOG_JOINTS.items()}
_GOAT_JOINTS['neck0'] = dataclasses.replace(_GOAT_JOINTS['neck0'], target=0.40041)

GOAT = CharacterSpec(
    name='goat',
    joints=_GOAT_JOINTS,
    fall_links=('root', 'spine0'),
    end_effectors=('finger', 'toe'),
    stumble_exempt=('toe', 'finger', 'ankle', 'wrist'),
    description='Goat, 21 links: the skeleton of the dog with horns; only ground contact of its rump is a fall.',
    clip='dog_bound',
    differences={
        'position': _TO_PARENT,
        'muscle': _BORROWED,
        'gait': (
            "action 0 is a retuned gait: with the original's gaits the goat falls here on flat "
            'ground; the original has the gait, but no environment for it',
        ),
    },
)

RAPTOR = CharacterSpec(
    name='raptor',
    joints=_RAPTOR_JOINTS,
    fall_links=('root', *_SPINE, 'head'),
    end_effectors=('right_toe', 'left_toe'),
    stumble_exempt=('right_toe', 'left_toe', 'right_ankle', 'left_ankle'),
    description='Raptor, 19 links: a heavy pelvis between a neck, a tail and two bird legs.',
    clip='raptor_run_050',
    differences={
        'position': _TO_PARENT,
        'gait': (
            "action 0 is the original's base action 1, which is more stable than its base action 0",
        ),
    },
)

BIPED2D = CharacterSpec(
    name='biped2d',
    joints=_BIPED2D_JOINTS,
    fall_links=('root',),
    end_effectors=('right_ankle', 'left_ankle'),
    stumble_exempt=('right_ankle', 'left_ankle'),
    torque_curves='human',
    description='Biped, 7 links: a trunk of 25 kg and two legs; the feet are the ankle links.',
    clip='biped2d_walk',
)

BIPED2D_SIMBICON = CharacterSpec(
    name='biped2d_simbicon',
    joints=_BIPED2D_SIMBICON_JOINTS,
    fall_links=('root',),
    end_effectors=('right_ankle', 'left_ankle'),
    stumble_exempt=('right_ankle', 'left_ankle', 'right_knee', 'left_knee'),
    torque_curves='human',
    description='Biped of the gait state machines, 7 links: the biped with heavier legs.',
    differences={
        'position': _TO_PARENT,
        'gait': (
            "action 0 is a retuned gait: with the original's gait the character falls here; "
            'torque is not rewarded',
        ),
    },
)

BIPED2D_FULL = CharacterSpec(
    name='biped2d_full',
    joints=_BIPED2D_FULL_JOINTS,
    fall_links=('root', 'right_hip', 'left_hip', *_ARMS, 'neck'),
    end_effectors=('right_ankle', 'left_ankle'),
    stumble_exempt=('right_ankle', 'left_ankle'),
    torque_curves='human',
    description='Biped with arms and head, 12 links, with human torque limits.',
    clip='biped2d_full_walk',
    differences={'muscle': _BORROWED},
)

HOPPER = CharacterSpec(
    name='hopper',
    joints=_HOPPER_JOINTS,
    fall_links=('root',),
    end_effectors=('leg',),  # none in the original's file; the foot is the lower end of the leg
    stumble_exempt=('leg',),
    description='Hopper, 3 links: a body on one leg, which slides along the thigh.',
    differences={
        'position': _TO_PARENT,
        'gait': (
            '9 parameters, applied at touch-down; the original declares 8, applied in mid-air',
        ),
    },
)

BIPED3D = CharacterSpec(
    name='biped3d',
    joints=_BIPED3D_JOINTS,
    fall_links=('root', 'torso'),
    end_effectors=('right_ankle', 'left_ankle'),
    stumble_exempt=('right_ankle', 'left_ankle'),
    torque_curves='human',
    description='Biped in 3D, 8 links; waist, hips and ankles are ball joints.',
    spatial=True,
    clip='biped3d_walk',
)

BIPED3D_MOCAP = dataclasses.replace(
    BIPED3D,
    name='biped3d_mocap',
    description='Biped in 3D with longer legs and a narrower pelvis, 8 links: the walker of DeepLoco.',
    clip='biped3d_mocap_walk',
)

BIPED3D_MOCAP_RUN = dataclasses.replace(
    BIPED3D,
    name='biped3d_mocap_run',
    joints=_BIPED3D_MOCAP_RUN_JOINTS,
    description='Biped in 3D that runs, 8 links: light legs, strong and stiff joints.',
    clip='biped3d_mocap_run',
    differences={'position': ('the ankles have an armature of 0.03 kg m^2',)},
)

BIPED3D_FULL_MOCAP = dataclasses.replace(
    BIPED3D,
    name='biped3d_full_mocap',
    joints=_BIPED3D_FULL_MOCAP_JOINTS,
    fall_links=tuple(
        link for link in ('root', *_BIPED3D_FULL_MOCAP_JOINTS) if not link.endswith('ankle')
    ),
    description='Biped in 3D with arms and head, 16 links; arms and head are almost rigid.',
    clip='biped3d_full_walk',
)

BIPED3D_SIMBICON = CharacterSpec(
    name='biped3d_simbicon',
    joints=_BIPED3D_SIMBICON_JOINTS,
    fall_links=('root',),
    end_effectors=('right_ankle', 'left_ankle'),
    stumble_exempt=('right_ankle', 'left_ankle', 'right_knee', 'left_knee'),
    torque_curves='human',
    description='Biped of the gait state machines in 3D, 7 links: no waist, hips close to the middle.',
    differences={'position': _TO_PARENT},
    spatial=True,
)

CHARACTERS: dict[str, CharacterSpec] = {
    spec.name: spec
    for spec in (
        *(DOG, GOAT, RAPTOR, BIPED2D, BIPED2D_SIMBICON, BIPED2D_FULL, HOPPER, BIPED3D),
        *(BIPED3D_MOCAP, BIPED3D_MOCAP_RUN, BIPED3D_FULL_MOCAP, BIPED3D_SIMBICON),
    )
}
