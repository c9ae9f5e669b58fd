"""Reading users' motions from files, whose format is recognised from their content."""

from __future__ import annotations

import pathlib
from typing import Any

from trl_suite.characters import CharacterSpec
from trl_suite.motion import Capture, Clip, readers
from trl_suite.motion import clip as clips
from trl_suite.motion.capture import read_amc, read_bvh
from trl_suite.rendering.kinematic_viewer import KinematicViewer
from trl_suite.util import errors
from trl_suite.util.files import Path, existing, read_json

FORMATS = {
    'bvh': 'BVH (begins with HIERARCHY)',
    'amc': 'Acclaim (.amc)',
    'json': 'JSON (TerrainRL, DeepTerrainRL, DeepMimic)',
    'npz': 'a clip (.npz)',
}
HEAD = 65536  # bytes at the beginning of a file from which its format is recognised


def read(
    path: Path, character: str | CharacterSpec, skeleton: Path | None = None, **options: Any
) -> Clip | Capture:
    """Reads a motion file; its format is recognised from its content, not from its name.

    Args:
      path: BVH; Acclaim (.amc, CMU); JSON of TerrainRL or DeepTerrainRL, with the character's joints in
        its order, or of DeepMimic, with the joints of its humanoid or its dog; or a file of `Clip.save`
        (.npz).
      character: whose joints a JSON of TerrainRL or DeepTerrainRL has; other formats ignore it.
      skeleton: the .asf file that belongs to an Acclaim file; None for other formats.
      **options: of `motion.read_bvh` or `motion.read_amc`.

    Raises:
      ValueError: another format, a malformed file, or options of another format.
      FileNotFoundError: there is no such file.
      ImportError: for BVH, if the extra 'clips' is not installed.
    """
    path = existing(path)
    found = _format(path)
    if found == 'amc' and skeleton is None:
        raise ValueError(f'{path}: an .amc file needs its skeleton, an .asf file')
    if found != 'amc' and skeleton is not None:
        raise ValueError(
            f'{path}: a skeleton ({skeleton}) was given, but the file is not an .amc file'
        )
    own = {'bvh': ('unit', 'forward', 'up'), 'amc': ('rate', 'unit', 'forward', 'up')}.get(
        found, ()
    )
    with errors.naming(path):
        errors.check_known(f'option of .{found} files', own, *options)
    if found == 'bvh':
        return read_bvh(path, **options)
    if found == 'amc':
        assert skeleton is not None
        return read_amc(path, skeleton, **options)
    if found == 'npz':
        return clips.load(path)
    content = read_json(path)
    # The two formats differ in `Loop`.
    if isinstance(content, dict) and isinstance(content.get('Loop'), str):
        return readers.read_deepmimic(path)
    layout = KinematicViewer(character).layout
    return readers.read_terrainrl(path, layout.joints, layout.sizes, layout.root)


def _format(path: pathlib.Path) -> str:
    """Returns which of `FORMATS` a file has."""
    with path.open('rb') as file:
        head = file.read(HEAD)
    if head.startswith(b'PK'):
        return 'npz'
    text = head.decode('utf-8-sig', errors='replace').lstrip()
    if text.startswith('{'):
        return 'json'
    if text.upper().startswith('HIERARCHY'):
        return 'bvh'
    lines = [line.split('#')[0].strip() for line in text.splitlines()]
    words = [line.split() for line in lines if line]
    if any(line[0].lower() in (':bonedata', ':hierarchy', ':root') for line in words):
        raise ValueError(
            f'{path}: a skeleton (.asf); expected the motion (.amc) that belongs to it'
        )
    # After sections, the first frame begins with its number.
    first = next((line for line in words if not line[0].startswith(':')), [''])
    if len(first) == 1 and first[0].isdigit():
        return 'amc'
    known = '; '.join(FORMATS.values())
    what = 'is empty' if not text else 'not a motion file'
    raise ValueError(f'{path}: {what}; expected one of: {known}')
