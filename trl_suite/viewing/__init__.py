"""Pictures, videos, replays and viewers of environments."""
