"""What tasks measure of a character: places, velocities and contacts, relative to its ground."""
