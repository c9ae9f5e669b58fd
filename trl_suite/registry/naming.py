"""How ids and descriptions name characters and their gaits, and what the original registers."""

# The original's name of each character in ids, and the words for descriptions.
NAMES = {'biped2d': 'Biped2D', 'biped2d_full': 'Biped2D', 'dog': 'Dog2D', 'raptor': 'Raptor2D'}
GAITS = {
    'biped2d_walk': 'walk', 'biped2d_run': 'run', 'biped2d_full_walk': 'walk', 'dog_bound': 'bound',
    'raptor_run_050': 'run', 'raptor_run_066': 'run',
}  # fmt: skip

NOT_REGISTERED = {
    'PD_Dog2D_Flat_Terrain-v0', 'PD_Raptor2D_Flat_Terrain-v0', 'PD_Biped2D_Mixed_Terrain-v0',
    'PD_Dog2D_Mixed_Terrain-v0', 'PD_Raptor2D_Mixed_Terrain-v0', 'PD_Dog2D_Flat-v0',
    'PD_Raptor2D_Flat-v0',
}  # fmt: skip


def status(id_: str, original: bool) -> str:
    """Returns the tag that tells whether the original registers an environment."""
    return 'original' if original and id_ not in NOT_REGISTERED else 'completion'
