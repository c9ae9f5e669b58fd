"""Walking without a reference motion: for characters without a clip, and for custom tasks."""
