"""All environments, as data."""
