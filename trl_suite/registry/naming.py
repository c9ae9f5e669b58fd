"""Names of characters and gaits in ids and descriptions, and which ids the original registers."""

# Names of characters in the original's ids, and words for the gaits in descriptions.
NAMES = {
    'biped2d': 'Biped2D', 'biped2d_full': 'Biped2D', 'biped2d_simbicon': 'Biped2D', 'dog': 'Dog2D',
    'goat': 'Goat2D', 'hopper': 'Hopper2D', 'raptor': 'Raptor2D',
}  # fmt: skip
GAITS = {
    'biped2d_walk': 'walk',
    'biped2d_run': 'run',
    'biped2d_full_walk': 'walk',
    'dog_bound': 'bound',
    'raptor_run_050': 'run',
    'raptor_run_066': 'run',
}

NOT_REGISTERED = {
    'PD_Dog2D_Flat_Terrain-v0',
    'PD_Raptor2D_Flat_Terrain-v0',
    'PD_Biped2D_Mixed_Terrain-v0',
    'PD_Dog2D_Mixed_Terrain-v0',
    'PD_Raptor2D_Mixed_Terrain-v0',
    'PD_Dog2D_Flat-v0',
    'PD_Raptor2D_Flat-v0',
}


def status(id_: str, original: bool) -> str:
    """Returns the tag for whether the original registers an environment."""
    return 'original' if original and id_ not in NOT_REGISTERED else 'completion'
