"""The TerrainRL family: actions set the parameters of a gait state machine."""
