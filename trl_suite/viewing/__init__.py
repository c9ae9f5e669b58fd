"""Interactive viewing, and the gallery of pictures."""
